"""Trainings of rivals: `python benchmarks/rivals.py SYSTEM [--help]`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.rivals.trainings import main

if __name__ == "__main__":
    main(sys.argv[1:])
