"""Windows of recordings for training, and their DataModules.

Open `windows.py` first: each system's `training_windows.py` is made alike. Where recordings come from: `wearcap.prepare`.
"""
