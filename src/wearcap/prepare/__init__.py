"""Preparation: sources in, a data set of recordings out.

Open `engine.py` first. Sources: `worn.py` (worn sensors), `mocap_sources.py` (motion capture; `foreign.py` reads
its files), `one_object.py` (people with an
object), `simulated.py`; `embeddings.py` and `keypoints.py` add to a data set. `conf/prepare/` names what `wearcap prepare` runs.
"""

from wearcap.prepare.engine import Report, Splits, Task, check_recording, content_hash, prepare

__all__ = ["Report", "Splits", "Task", "check_recording", "content_hash", "prepare"]
