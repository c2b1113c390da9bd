"""Turn a recording into motion: `python capture.py pipeline=hmd2 checkpoint=… recording=…` (see `--help`)."""

import sys

import hydra
from omegaconf import DictConfig

from wearcap.cli.capture import run as capture
from wearcap.cli.conf import guarded
from wearcap.cli.main import run_verb


@hydra.main(version_base="1.3", config_path="conf", config_name="capture")
@guarded
def main(config: DictConfig) -> object:
    """Load the system, capture the recording, and write motion and video."""
    return capture(config)


if __name__ == "__main__":
    sys.exit(run_verb("capture", sys.argv[1:], main))
