"""Any file as a recording: prepared recordings, suits, motion capture, device folders and logs, recognised by content.

`any_file.py` has `read`; `stature.py` says whose body it is where the file does not.
"""

from wearcap.reading.any_file import read

__all__ = ["read"]
