"""Export a checkpoint: `python export.py checkpoint=… format=onnx|pt2` (see `--help`)."""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("export", sys.argv[1:]))
