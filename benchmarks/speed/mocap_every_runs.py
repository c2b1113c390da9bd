"""Walks for benchmarks of MocapEvery: the shared checkpoint, or its size with drawn weights, and a climb with watches."""

import sys
from dataclasses import replace

import torch
from hydra.utils import instantiate

from benchmarks.speed.online import figure
from benchmarks.speed.planted import swinging
from wearcap.cli.conf import compose, load_pipeline
from wearcap.models.checkpoint import shared_checkpoints
from wearcap.recording import Recording
from wearcap.sensors.imu import synthesize_imu
from wearcap.systems.mocap_every.pipeline import MocapEvery

NAME = "mocap_every"
__all__ = ["figure", "pipeline_of", "watched"]


def pipeline_of(config_name: str) -> MocapEvery:
    """A pipeline config around the project's checkpoint, or around drawn weights of that size, which is printed."""
    config = compose("capture", [f"pipeline={config_name}", "recording=none"]).pipeline
    if NAME in shared_checkpoints():
        pipeline = load_pipeline(NAME, config, "cpu")
        assert isinstance(pipeline, MocapEvery)
        return pipeline
    torch.manual_seed(0)
    system = instantiate(compose("train", [f"experiment={NAME}"]).model, _convert_="all").eval()
    count = sum(parameter.numel() for parameter in system.net.parameters()) / 1e6
    print(f"no checkpoint {NAME!r}: drawn weights, {count:.1f} M parameters", file=sys.stderr)
    return instantiate(config, _convert_="all")(**system.pipeline_parts(), device="cpu")


def watched(duration_s: float) -> Recording:
    """A swinging walk at 30 Hz with watches, on a floor whose height is known."""
    recording = swinging("walk", duration_s, 0, fps=30.0)
    assert recording.motion is not None
    imu = {joint: synthesize_imu(recording.motion, joint) for joint in ("left_wrist", "right_wrist")}
    return replace(recording, imu=imu)
