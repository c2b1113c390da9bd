"""The verbs: one module per verb with `main(arguments)`; `verbs.py` has their help.

Open `main.py` first: it dispatches to the verb and prints errors in one line. Hydra is used only here: `conf.py` composes
configs, and builds pipelines from them and from checkpoints.
"""
