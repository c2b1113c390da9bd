"""LightningModules, loss terms, callbacks, checkpoints.

One module per network, each its losses and nothing of its optimiser (`base.py`); open `motion_diffusion.py` (HMD²)
first, and `run.py` for what surrounds a run: its folder, its resumption, its record. Validation through whole
pipelines are callbacks: `callbacks.py`, `hps_validation.py`, `ireplica_validation.py`.
"""
