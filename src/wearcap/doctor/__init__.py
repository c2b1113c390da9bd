"""The doctor: reports the content of a recording, likely problems, and how to fix them.

Open `examine.py` first; `streams.py` (with the measurements that all share), `body.py`,
`consistency.py` and `places.py` check it; `report.py` holds checks, findings and their report.
"""

from wearcap.doctor.examine import examine_recording, require_sound
from wearcap.doctor.report import Finding, Report

__all__ = ["Finding", "Report", "examine_recording", "require_sound"]
