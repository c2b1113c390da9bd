"""Windows of recordings for training, drawn in batches.

Open `windows.py` first (the data set), then `batch.py` (what a batch is), `transforms.py` (its augmentations) and
`datamodule.py` (their order); each system's `training_windows.py` says what its windows hold. Where recordings come from:
`data_prep`.
"""
