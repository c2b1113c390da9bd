"""Train a model: `python train.py experiment=motion_diffusion_head data=cmu` (see `--help`)."""

import sys

import hydra
from omegaconf import DictConfig

from wearcap.cli.conf import guarded
from wearcap.cli.main import run_verb
from wearcap.cli.train import train


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
@guarded
def main(config: DictConfig) -> object:
    """Data, model, callbacks and trainer from the config, then fit and test; returns the last validation loss."""
    return train(config)


if __name__ == "__main__":
    sys.exit(run_verb("train", sys.argv[1:], main))
