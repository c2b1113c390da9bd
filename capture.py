"""Turn a recording into motion: `python capture.py pipeline=hmd2 checkpoint=… recording=…` (see `--help`)."""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("capture", sys.argv[1:]))
