"""What `run.py` measures: a module per benchmark, with `measure()`."""
