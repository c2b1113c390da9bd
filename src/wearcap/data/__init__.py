"""Windows of recordings, drawn for training, and the DataModules around them.

Open `windows.py` first: each system's `training_windows.py` is made alike. Where recordings come from: `wearcap.prepare`.
"""
