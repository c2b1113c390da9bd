"""Whatever a user has, read as a recording.

Open `any_file.py` first: the one table of kinds of files and folders (`kinds.py`); `kits.py` reads the logs of one session.
"""

from wearcap.reading.any_file import load, read

__all__ = ["load", "read"]
