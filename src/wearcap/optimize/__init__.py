"""What optimisers share: robust losses (`losses.py`), and bodies fitted to optical markers (`markers.py`).

HPS's energy and its solver are in `systems/hps/`, iReplica's trajectory correction in `systems/ireplica/`.
"""
