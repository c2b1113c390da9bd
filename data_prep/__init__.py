"""Data sets: a file for each that is read and prepared in its own way; `wearcap prepare NAME` runs it by `conf/prepare/`.

What they share, the engine that makes recordings first of all, lies in `shared/`.
"""
