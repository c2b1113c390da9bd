"""Windows, features, DataModules, and the preparation of data sets."""
