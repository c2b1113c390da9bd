"""Export a checkpoint: `python export.py checkpoint=… format=onnx|pt2` (see `--help`)."""

import sys

import hydra
from omegaconf import DictConfig

from wearcap.cli.conf import guarded
from wearcap.cli.export import run as export
from wearcap.cli.main import run_verb


@hydra.main(version_base="1.3", config_path="conf", config_name="export")
@guarded
def main(config: DictConfig) -> object:
    """Load the network, write it, and compare what was written with PyTorch."""
    return export(config)


if __name__ == "__main__":
    sys.exit(run_verb("export", sys.argv[1:], main))
