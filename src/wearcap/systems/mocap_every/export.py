"""MocapEvery's estimator as an exported graph; coordinate frames, floor and windows are the pipeline's own."""

from dataclasses import asdict
from typing import Any

import msgspec
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import FEET
from wearcap.errors import WearcapError
from wearcap.runtime.graphs import Count, Exports, Rate, Run, SkeletonEntry, skeleton_to_json
from wearcap.systems.mocap_every.features import WatchFeatures
from wearcap.systems.mocap_every.model import Estimate, WatchEstimator
from wearcap.systems.mocap_every.pipeline import MocapEvery, Overlap, WatchModel
from wearcap.tracking.refinement import Refinement


def exports(pipeline: MocapEvery) -> Exports:
    """Input: unnormalised `features` "batch window feature". Output: motion and contact logits "batch predicted motion+2".

    Raises WearcapError for a network that is exported already.
    """
    net, features = pipeline.model.net, pipeline.model.features
    if isinstance(net, _ExportedEstimator):
        raise WearcapError("a network that is exported already", expected="one of a checkpoint")
    about = {
        "features": asdict(features),
        "feature_size": features.size,
        "motion_size": features.motion_size,
        "window": net.window,
        "fps": pipeline.model.fps,
        "joint_dof": pipeline.model.joint_dof,
        "skeleton": skeleton_to_json(pipeline.model.skeleton),
        "settings": pipeline.settings(),
        "refinement": None if pipeline.refinement is None else asdict(pipeline.refinement),
    }
    return Exports("mocap_every", {"network": net.graph(features.size)}, about)


class _ExportedEstimator(WatchEstimator):
    """An estimator whose weights are in an exported file, run on the CPU."""

    def __init__(self, run: Run, window: int):
        super().__init__()
        self._run, self.window = (run,), window

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        output = self._run[0](features=features)
        return Estimate(output[..., :-FEET], output[..., -FEET:], None)


class Sidecar(msgspec.Struct):
    """What running an exported model takes of its sidecar."""

    features: WatchFeatures
    window: Count
    fps: Rate
    skeleton: SkeletonEntry
    settings: dict[str, int | float | str | bool]
    refinement: dict[str, Any] | None = None
    joint_dof: Rate | None = None


def from_export(runs: dict[str, Run], weights: dict[str, dict[str, Tensor]], about: Sidecar) -> MocapEvery:
    """The pipeline of an exported model."""
    net = _ExportedEstimator(runs["model"], about.window)
    model = WatchModel(net, about.features, about.skeleton.skeleton(), about.fps, about.joint_dof)
    own = {name: about.settings[name] for name in ("floor", "carried", "anchor")}
    return MocapEvery(
        model, msgspec.convert(about.settings, Overlap), refinement=Refinement.of(about.refinement), **own
    )
