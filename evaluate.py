"""Score a checkpoint on whole recordings: `python evaluate.py checkpoint=…` (see `--help`)."""

import sys

import hydra
from omegaconf import DictConfig

from wearcap.cli.conf import guarded
from wearcap.cli.evaluate import run as evaluate
from wearcap.cli.main import run_verb


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
@guarded
def main(config: DictConfig) -> object:
    """Capture every recording of the split, score it, and show and write the table."""
    return evaluate(config)


if __name__ == "__main__":
    sys.exit(run_verb("evaluate", sys.argv[1:], main))
