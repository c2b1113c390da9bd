"""Motion as the minimum of an energy: terms as pure functions, problems that list them, solvers.

HPS: the table of terms in `hps.py` with their costs in `costs.py`, minimised by `banded.py` (ours) or `adam_windows.py`
(thesis). iReplica's trajectory correction: `trajectory.py`. Open `costs.py` and `hps.py` first.
"""
