"""Measures: `python benchmarks/run.py [NAME …]`; `--list` names the benchmarks."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.speed.command import main

if __name__ == "__main__":
    main(sys.argv[1:])
