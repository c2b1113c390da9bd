"""Files of any origin as recordings, for preparation and for reading: foreign motion files, suits, a wearer's own logs."""
