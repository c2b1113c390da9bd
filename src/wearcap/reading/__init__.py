"""Whatever a user has, read and examined.

Open `any_file.py` first: the one table of readers by suffix and content; `kits.py` reads the logs of one session, and
`examine.py` reports on everything in a path.
"""

from wearcap.reading.any_file import load, read
from wearcap.reading.examine import examine

__all__ = ["examine", "load", "read"]
