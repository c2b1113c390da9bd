"""Walks for benchmarks of MocapEvery: the shared checkpoint, and a walk with watches."""

from dataclasses import replace

from benchmarks.speed.planted import swinging
from wearcap.cli.conf import compose, load_pipeline
from wearcap.recording import Recording
from wearcap.sensors.imu import synthesize_imu
from wearcap.systems.mocap_every.pipeline import MocapEvery


def pipeline_of(config_name: str) -> MocapEvery:
    """A pipeline config around the shared checkpoint."""
    config = compose("capture", [f"pipeline={config_name}", "recording=none"]).pipeline
    pipeline = load_pipeline("mocap_every", config, "cpu")
    assert isinstance(pipeline, MocapEvery)
    return pipeline


def watched(duration_s: float) -> Recording:
    """A swinging walk at 30 Hz with watches, on a floor whose height is known."""
    recording = swinging("walk", duration_s, 0, fps=30.0)
    assert recording.motion is not None
    imu = {joint: synthesize_imu(recording.motion, joint) for joint in ("left_wrist", "right_wrist")}
    return replace(recording, imu=imu)
