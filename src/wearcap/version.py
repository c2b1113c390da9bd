"""The package's version, for whoever stands below its face."""

__version__ = "0.1.0"
