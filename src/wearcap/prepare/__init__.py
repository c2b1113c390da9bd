"""Preparation: sources in, a data set of recordings out.

Open `engine.py` first. `data_prep/` has a file per data set; here is what they share: motion capture on training skeletons
(`mocap.py`; files of any origin, `foreign.py`), suits, and a wearer's own logs. `data_prep/` names what `wearcap prepare` runs.
"""

from wearcap.prepare.engine import Report, Splits, Task, check_recording, content_hash, prepare

__all__ = ["Report", "Splits", "Task", "check_recording", "content_hash", "prepare"]
