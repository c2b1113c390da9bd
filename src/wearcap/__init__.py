"""Motion capture from what a person wears."""

__version__ = "0.1.0"
