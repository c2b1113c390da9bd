"""LightningModules, loss terms, callbacks, checkpoints."""
