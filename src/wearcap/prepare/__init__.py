"""Files of any origin as recordings, for preparation and for reading: foreign motion files, suits, a wearer's own logs.

`data_prep/` has a file per data set; `data_prep/shared/engine.py` makes their recordings.
"""
