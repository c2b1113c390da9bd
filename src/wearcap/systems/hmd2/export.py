"""HMD²'s networks as exported graphs. Windows, features and sampler are the pipeline's own: the same noise gives the
same motion."""

from dataclasses import asdict
from inspect import Parameter, Signature
from typing import Any

import msgspec
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.data.features import LIMBS
from wearcap.errors import WearcapError
from wearcap.models.layers import Normalizer
from wearcap.runtime import graphs
from wearcap.runtime.graphs import ROT6D, Count, Exports, Graph, Rate, Run
from wearcap.scene.voxels import VoxelGrid
from wearcap.systems.hmd2.conditions import CONDITIONS, Condition, Exported
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2, Overlap, Sampling
from wearcap.systems.hmd2.windows import DiffusionModel
from wearcap.tracking.refinement import Refinement

SETTINGS = ("steps", "stride", "eta", "spacing", "guidance", "inpaint", "fade", "lookahead", "live", "use")


def condition_graph(net: MotionDenoiser, inputs: dict[str, Tensor]) -> Graph:
    """The part of a denoiser that is computed once per window: the encoding of its conditions, each by its name."""

    class ConditionGraph(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net

        def forward(self, **inputs: Tensor) -> Float[Tensor, "batch token width"]:
            head, parts = inputs["head"], [(inputs[name], inputs[f"{name}_valid"]) for name in self.net.conditions]
            others, given = torch.cat([head[..., :0], *(part for part, _ in parts)], -1), head[..., :0].bool()
            given = torch.stack([valid for _, valid in parts], -1) if parts else given
            return self.net.encode(Conditions(head, others, given), inputs["valid"])

    # Inputs of an exported graph are named by its signature.
    names = [
        Parameter("self", Parameter.POSITIONAL_ONLY),
        *(Parameter(name, Parameter.KEYWORD_ONLY) for name in inputs),
    ]
    ConditionGraph.forward.__signature__ = Signature(names)  # pyright: ignore[reportFunctionMemberAccess]
    return Graph(ConditionGraph(), inputs)


def exports(pipeline: HMD2) -> Exports:
    """The step; the level's plan; the encoding of conditions, once per window; and, for a network with points, the
    encoder of the grids (m) around the body. Rotations of the motion are 6D in `features.frame`.

    Raises WearcapError for a network that is exported already, and for an unknown schedule.
    """
    model, random = pipeline.model, torch.Generator().manual_seed(0)
    net, features = model.net, model.features
    if isinstance(net, _ExportedDenoiser):
        raise WearcapError("a network that is exported already", expected="one of a checkpoint")
    shape = 2, pipeline.window
    made = net.graphs(pipeline.window)
    valid, normalizer = made["step"].inputs["valid"], net.condition_encoder.normalizer
    noise = torch.randn(*shape, len(normalizer.scale), generator=random)
    inputs = {"head": normalizer.mean.cpu() + normalizer.scale.cpu() * noise, "valid": valid}
    for name, size in net.conditions.items():
        present = valid & (torch.rand(shape, generator=random) < 0.7)
        inputs |= {name: torch.randn(*shape, size, generator=random), f"{name}_valid": present}
    made["conditions"] = condition_graph(net, inputs)
    for condition in model.conditions.values():
        made |= condition.graphs(random)
    conditions = {name: _entry(condition) for name, condition in model.conditions.items()}
    feet = ["left_foot.contact", "right_foot.contact"] if features.contacts else []
    settings = asdict(pipeline.sampling) | asdict(pipeline.overlap) | {"live": pipeline.live, "use": [*pipeline.used]}
    about = {
        "window": pipeline.window,
        "fps": model.fps,
        "settings": {name: settings[name] for name in SETTINGS},
        "refinement": None if pipeline.refinement is None else asdict(pipeline.refinement),
        "schedule": graphs.schedule_to_json(model.schedule),
        "features": asdict(features),
        "condition_channels": condition_channels(features),
        "motion_channels": [*(f"{joint}.{entry}" for joint in model.skeleton.joint_names for entry in ROT6D), *feet],
        "motion_mean": net.motion_normalizer.mean.tolist(),
        "motion_scale": net.motion_normalizer.scale.tolist(),
        "condition_size": net.condition_size,
        "self_conditioning": net.self_conditioning,
        "conditions": conditions,
        # Points and images apart, as files of before have them.
        "points_size": net.conditions.get("points", 0),
        "image_size": net.conditions.get("image", 0),
        "image_encoder": conditions.get("image", {}).get("encoder"),
        "grid": conditions.get("points", {}).get("grid"),
        "skeleton": graphs.skeleton_to_json(model.skeleton),
        "joint_dof": model.joint_dof,
    }
    return Exports("hmd2", made, about)


def _entry(condition: Condition) -> dict[str, Any]:
    """What the sidecar holds of a condition."""
    encoder = condition.encoder
    named, grid = encoder if isinstance(encoder, str) else None, getattr(encoder, "grid", None)
    return msgspec.to_builtins(Exported(condition.size, named, grid))


def condition_channels(features: HeadFeatures) -> list[str]:
    """Names of the head's channels in order; they enter the network unnormalised."""
    horizontal = ["offset_x", "offset_y"] if features.frame == "window" else []
    return [
        *horizontal,
        f"height_{features.height}",
        *(f"head.{entry}" for entry in ROT6D),
        *(f"velocity_{axis}" for axis in "xyz"),
        *(f"angular_velocity_{axis}" for axis in "xyz"),
        *(f"size.{limb}" for limb in LIMBS if features.body),
    ]


class _ExportedDenoiser(MotionDenoiser):
    """A `MotionDenoiser` whose weights are in exported files, run on the CPU."""

    def __init__(self, runs: dict[str, Run], about: "Sidecar"):
        nn.Module.__init__(self)  # no blocks of its own
        self._runs = (runs,)
        self.window, self.condition_size = about.window, about.condition_size
        self.conditions = {name: entry.size for name, entry in about.others().items()}
        self.self_conditioning = about.self_conditioning
        self.motion_size = len(about.motion_mean)
        self.motion_normalizer = Normalizer(self.motion_size)
        self.motion_normalizer.set(torch.tensor(about.motion_mean), torch.tensor(about.motion_scale))

    def encode(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Float[Tensor, "batch token width"]:
        inputs = {"head": conditions.head, "valid": valid}
        parts = conditions.others.split([*self.conditions.values()], -1)
        for name, part, given in zip(self.conditions, parts, conditions.given.unbind(-1)):
            inputs |= {name: part, f"{name}_valid": given}
        return self._runs[0]["conditions"](**inputs)

    def graphs(self, window: int | None = None) -> dict[str, Graph]:
        """The exported graphs themselves, whose window is fixed."""
        return {"step": Graph(self._runs[0]["model"], {}), "plan": Graph(self._runs[0]["plan"], {})}


class Sidecar(msgspec.Struct):
    """What running an exported model takes of its sidecar."""

    window: Count
    fps: Rate
    settings: dict[str, Any]
    features: HeadFeatures
    schedule: dict[str, float | str]
    skeleton: graphs.SkeletonEntry
    motion_mean: list[float]
    motion_scale: list[float]
    condition_size: Count
    self_conditioning: bool
    conditions: dict[str, Exported] | None = None
    points_size: Count = 0
    image_size: Count = 0
    image_encoder: str | None = None
    grid: VoxelGrid | None = None
    refinement: dict[str, Any] | None = None
    joint_dof: graphs.Rate | None = None

    def others(self) -> dict[str, Exported]:
        """The conditions beside the head; files of before have those of points and images apart."""
        if self.conditions is not None:
            return self.conditions
        former = {
            "points": Exported(self.points_size, grid=self.grid),
            "image": Exported(self.image_size, self.image_encoder),
        }
        return {name: entry for name, entry in former.items() if entry.size}


def from_export(runs: dict[str, Run], weights: dict[str, dict[str, Tensor]], about: Sidecar) -> HMD2:
    """The pipeline of an exported model."""
    conditions = {name: CONDITIONS[name].of_export(entry, runs) for name, entry in about.others().items()}
    schedule, skeleton = graphs.schedule_from_json(about.schedule), about.skeleton.skeleton()
    parts = about.features, schedule, skeleton, about.fps, conditions, about.joint_dof
    model = DiffusionModel(_ExportedDenoiser(runs, about), *parts)
    sampling, overlap = (msgspec.convert(about.settings, kind) for kind in (Sampling, Overlap))
    live, use = bool(about.settings["live"]), tuple(about.settings["use"])
    return HMD2(model, sampling, overlap, use, Refinement.of(about.refinement), live)
