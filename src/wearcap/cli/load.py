"""From a checkpoint to the system its own config describes, and to a pipeline around it."""

from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from wearcap.pipelines.hmd2 import HMD2
from wearcap.training.checkpoint import load_weights, read_checkpoint
from wearcap.training.motion_diffusion import MotionDiffusion


def load_system(checkpoint: str | Path) -> tuple[MotionDiffusion, dict[str, Any]]:
    """The trained system (averaged weights, evaluation mode) and the config it was trained with."""
    config, state = read_checkpoint(checkpoint)
    system = instantiate(config["model"], _convert_="all")
    load_weights(system, state, checkpoint)
    return system.eval(), config


def load_pipeline(checkpoint: str | Path, pipeline: DictConfig, device: str) -> HMD2:
    """The pipeline of a config group around a checkpoint's network."""
    system, _ = load_system(checkpoint)
    return instantiate(pipeline, _convert_="all")(
        net=system.net, features=system.features, schedule=system.schedule, skeleton=system.skeleton,
        fps=system.fps, device=device,
    )  # fmt: skip


def trained_on(checkpoint: str | Path) -> tuple[list[str], str]:
    """(folders of the training data sets, folder of the one it was validated on)."""
    data = read_checkpoint(checkpoint)[0]["data"]
    sources = [source["root"] for source in data["sources"].values() if source]
    validated = [source["root"] for source in (data["val_sources"] or data["sources"]).values() if source]
    return sources, validated[0]
