"""HMD²'s networks as exported graphs. Windows, features and sampler are the pipeline's own: the same noise gives the
same motion."""

from dataclasses import asdict
from typing import Any

import msgspec
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.data.features import LIMBS
from wearcap.errors import WearcapError
from wearcap.models.layers import Normalizer
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.runtime import graphs
from wearcap.runtime.graphs import ROT6D, Call, Count, Exports, Graph, Rate, Run
from wearcap.scene.voxels import VoxelGrid
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2, DiffusionModel, Overlap, Sampling
from wearcap.tracking.refinement import Refinement

SETTINGS = ("steps", "stride", "eta", "spacing", "guidance", "inpaint", "fade", "lookahead", "live", "use")


class _ConditionGraph(nn.Module):
    """The part of a denoiser that is computed once per window: the encoding of its conditions."""

    def __init__(self, net: MotionDenoiser):
        super().__init__()
        self.net = net

    def forward(
        self,
        head: Float[Tensor, "batch time head_feature"],
        valid: Bool[Tensor, "batch time"],
        points: Float[Tensor, "batch time point_feature"] | None = None,
        points_valid: Bool[Tensor, "batch time"] | None = None,
        image: Float[Tensor, "batch time image_feature"] | None = None,
        image_valid: Bool[Tensor, "batch time"] | None = None,
    ) -> Float[Tensor, "batch token width"]:
        none = head[..., :0]
        conditions = Conditions(
            head,
            none if points is None else points,
            valid if points_valid is None else points_valid,
            none if image is None else image,
            valid if image_valid is None else image_valid,
        )
        return self.net.encode(conditions, valid)


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
    for name, size in (("points", net.points_size), ("image", net.image_size)):
        if size:
            present = valid & (torch.rand(shape, generator=random) < 0.7)
            inputs |= {name: torch.randn(*shape, size, generator=random), f"{name}_valid": present}
    made["conditions"] = Graph(_ConditionGraph(net), inputs)
    if model.place_encoder is not None and net.points_size:
        grid = model.place_encoder.grid
        grids = grid.clip_m * torch.rand(2, *[grid.cells] * 3, generator=random)
        made["places"] = Graph(Call(model.place_encoder, "encode"), {"grids": grids})
    feet = ["left_foot.contact", "right_foot.contact"] if features.contacts else []
    settings = asdict(pipeline.sampling) | asdict(pipeline.overlap) | {"live": pipeline.live, "use": list(pipeline.use)}
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
        **{name: getattr(net, name) for name in ("condition_size", "points_size", "image_size", "self_conditioning")},
        "image_encoder": model.image_encoder,
        "grid": None if model.place_encoder is None else asdict(model.place_encoder.grid),
        "skeleton": graphs.skeleton_to_json(model.skeleton),
    }
    return Exports("hmd2", made, about)


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
        self.points_size, self.image_size = about.points_size, about.image_size
        self.self_conditioning = about.self_conditioning
        self.motion_size = len(about.motion_mean)
        self.motion_normalizer = Normalizer(self.motion_size)
        self.motion_normalizer.set(torch.tensor(about.motion_mean), torch.tensor(about.motion_scale))

    def encode(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Float[Tensor, "batch token width"]:
        inputs = {"head": conditions.head, "valid": valid}
        if self.points_size:
            inputs |= {"points": conditions.points, "points_valid": conditions.points_valid}
        if self.image_size:
            inputs |= {"image": conditions.image, "image_valid": conditions.image_valid}
        return self._runs[0]["conditions"](**inputs)

    def graphs(self, window: int | None = None) -> dict[str, Graph]:
        """The exported graphs themselves, whose window is fixed."""
        return {"step": Graph(self._runs[0]["model"], {}), "plan": Graph(self._runs[0]["plan"], {})}


class _ExportedPlaces(VoxelAutoencoder):
    """The encoder of the points around the body, with its weights in an exported file."""

    def __init__(self, run: Run, grid: VoxelGrid, size: int):
        nn.Module.__init__(self)
        self._run, self.grid, self.size = run, grid, size

    def encode(self, grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch feature"]:
        flat = grids.reshape(-1, *grids.shape[-3:])
        return self._run(grids=flat).reshape(*grids.shape[:-3], self.size)


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
    points_size: Count
    image_size: Count
    self_conditioning: bool
    image_encoder: str | None
    grid: VoxelGrid | None = None
    refinement: dict[str, Any] | None = None


def from_export(runs: dict[str, Run], weights: dict[str, dict[str, Tensor]], about: Sidecar) -> HMD2:
    """The pipeline of an exported model."""
    places = None
    if "places" in runs and about.grid is not None:
        places = _ExportedPlaces(runs["places"], about.grid, about.points_size)
    schedule, skeleton = graphs.schedule_from_json(about.schedule), about.skeleton.skeleton()
    net = _ExportedDenoiser(runs, about)
    model = DiffusionModel(net, about.features, schedule, skeleton, about.fps, places, about.image_encoder)
    sampling, overlap = (msgspec.convert(about.settings, kind) for kind in (Sampling, Overlap))
    live, use = bool(about.settings["live"]), tuple(about.settings["use"])
    return HMD2(model, sampling, overlap, use, Refinement.of(about.refinement), live)
