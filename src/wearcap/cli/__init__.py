"""The verbs: one module per verb with `HELP` (one line) and `main(arguments)`."""
