"""Score a checkpoint on whole recordings: `python evaluate.py checkpoint=…` (see `--help`)."""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("evaluate", sys.argv[1:]))
