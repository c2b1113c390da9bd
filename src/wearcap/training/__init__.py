"""Shared parts of training: the base of LightningModules, loss terms, callbacks, checkpoints, and a run's folder.

Each system's losses stand in its own `training.py`; `run.py` is what surrounds a run: its folder, resumption, record.
"""
