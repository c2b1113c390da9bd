"""The verbs: one module per verb with `HELP` (one line) and `main(arguments)`.

Open `main.py` first: it finds the verb and ends errors in one line. Hydra is known here alone: `conf.py` composes
configs, `load.py` makes pipelines of them and of checkpoints.
"""
