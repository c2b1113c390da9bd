"""Windows, features, DataModules, and the preparation of data sets.

What a network sees and says are its `*_features.py`; `*_windows.py` draw them from recordings, for `datamodule.py`.
Open `windows.py` and `features.py` (HMD²) first: the other systems' are made alike. `prepare/` makes the data sets.
"""
