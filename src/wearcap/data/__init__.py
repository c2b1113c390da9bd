"""Windows of recordings for training.

Open `windows.py` first (the data set), then `transforms.py` (its augmentations) and `datamodule.py` (how samples are
loaded); each system's `training_windows.py` says what its windows hold. Where recordings come from: `data_prep`.
"""
