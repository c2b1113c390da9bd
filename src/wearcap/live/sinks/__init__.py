"""Sinks: where live motion goes, one protocol or kind of file a module."""
