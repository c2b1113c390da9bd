"""What optimisers share: robust losses.

HPS's energy and its solver are in `systems/hps/`, iReplica's trajectory correction in `systems/ireplica/`.
"""
