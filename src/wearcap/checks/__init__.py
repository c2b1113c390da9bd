"""Checks of a recording: likely problems, and how to fix them, for every verb that reads one.

Open `examine.py` first; `streams.py` (with the measurements that all share), `body.py`,
`consistency.py` and `places.py` check it; `report.py` holds checks, findings and their report.
"""

from wearcap.checks.examine import examine_recording, require_sound
from wearcap.checks.report import Finding, Report

__all__ = ["Finding", "Report", "examine_recording", "require_sound"]
