"""Motion as the minimum of an energy: terms as pure functions, problems that list them, solvers.

HPS is `hps.py` with its terms in `costs.py`, solved by `banded.py` (ours) or `adam_windows.py` (as documented);
iReplica's bent path is `trajectory.py`, MocapEvery's editing `latent_motion.py`. Open `costs.py` and `hps.py` first.
"""
