"""Methods that systems are compared with: their networks, configs, trainings, figures of their papers, baselines and scores.

Importing this package lets checkpoints name its networks; `SEARCH` lets `wearcap` choose its configs.
"""

from collections.abc import Iterable
from pathlib import Path

from omegaconf import DictConfig

from wearcap.cli import conf
from wearcap.models.build import MOVED, TARGETS

SEARCH = f"hydra.searchpath=['file://{Path(__file__).resolve().parent / 'conf'}']"
"""Override with which any verb finds the configs of this folder beside its own."""

TARGETS |= {
    "benchmarks.rivals.last_pose": ("LastPoseEstimator",),
    "benchmarks.rivals.pose_regression.features": ("TrackedPoints",),
    "benchmarks.rivals.pose_regression.net": ("PoseRegressor",),
    "benchmarks.rivals.pose_regression.training": ("PoseRegression",),
}
MOVED |= {
    "wearcap.models.pose_regressor.PoseRegressor": "benchmarks.rivals.pose_regression.net.PoseRegressor",
    "wearcap.systems.hmd2.pose_regressor.features.TrackedPoints": "benchmarks.rivals.pose_regression.features.TrackedPoints",
    "wearcap.systems.hmd2.pose_regressor.training.PoseRegression": "benchmarks.rivals.pose_regression.training.PoseRegression",
    "wearcap.systems.mocap_every.model.LastPoseEstimator": "benchmarks.rivals.last_pose.LastPoseEstimator",
}


def compose(config_name: str, overrides: Iterable[str] = ()) -> DictConfig:
    """`wearcap.cli.conf.compose` with the configs of this folder."""
    return conf.compose(config_name, [SEARCH, *overrides])
