"""Data sets: a file for each that is read and prepared in its own way; `wearcap prepare NAME` calls NAME_tasks, whose
arguments are its settings. What they share, the engine that makes recordings first of all, lies in `shared/`.
"""
