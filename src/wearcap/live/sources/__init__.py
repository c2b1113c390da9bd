"""Sources: what devices and their applications send, one protocol a module."""
