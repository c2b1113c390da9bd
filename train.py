"""Train a model: `python train.py experiment=motion_diffusion_head data=cmu` (see `--help`)."""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("train", sys.argv[1:]))
