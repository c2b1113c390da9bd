"""Export of HMD²'s denoiser to ONNX or torch.export with a sidecar, and a pipeline that runs the exported files.

    python -m wearcap.export.hmd2 MODEL.onnx RECORDING.safetensors MOTION.safetensors

Windows, features and sampler are the eager pipeline's own: the same noise gives the same motion.
"""

from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.body.skeleton import Skeleton
from wearcap.data.features import LIMBS
from wearcap.errors import WearcapError
from wearcap.export import command
from wearcap.export.exported import Run, open_exported
from wearcap.export.network import ExportReport, export_network
from wearcap.export.sidecar import (
    ROT6D,
    SCHEDULES,
    file_entry,
    header,
    part_path,
    read_sidecar,
    skeleton_from_json,
    skeleton_to_json,
    write_sidecar,
)
from wearcap.models.layers import Normalizer
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.scene.voxels import VoxelGrid
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, LevelPlan, MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2

MAX_ERROR = 1e-4


class ConditionGraph(nn.Module):
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


class PlaceGraph(nn.Module):
    """Codes of voxel grids (m) of the points around the body."""

    def __init__(self, encoder: VoxelAutoencoder):
        super().__init__()
        self.encoder = encoder

    def forward(self, grids: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch feature"]:
        return self.encoder.encode(grids)


def export_hmd2(pipeline: HMD2, path: str | Path, format: str) -> dict[str, ExportReport]:
    """Write the pipeline's networks in a format, .onnx or .pt2, and a sidecar of `path`'s name with .json.

    `path` is the step (x_t, level, encoded, valid, and last with self-conditioning); NAME.conditions makes `encoded`
    once per window; NAME.places, for a network with point conditioning, encodes the grids around the body. Returns the
    reports by these names. Raises what `export_network` raises.
    """
    net, random, path = pipeline.net, torch.Generator().manual_seed(0), Path(path)
    shape = 2, net.window
    valid = torch.arange(net.window).expand(2, -1) < net.window - 3
    normalizer = net.condition_encoder.normalizer
    noise = torch.randn(*shape, len(normalizer.scale), generator=random)
    inputs = {"head": normalizer.mean.cpu() + normalizer.scale.cpu() * noise, "valid": valid}
    for name, size in (("points", net.points_size), ("image", net.image_size)):
        if size:
            present = valid & (torch.rand(shape, generator=random) < 0.7)
            inputs |= {name: torch.randn(*shape, size, generator=random), f"{name}_valid": present}
    tokens, width = net.window // net.frames_per_token, net.motion_encoder.linear.out_features
    x_t, last = torch.randn(2, *shape, net.motion_size, generator=random)
    step = {
        "x_t": x_t,
        "level": torch.rand(2, 1, generator=random),
        "encoded": torch.randn(2, tokens, width, generator=random),
        "valid": valid,
    }
    graphs = {
        "step": (net, step | ({"last": last} if net.self_conditioning else {})),
        "conditions": (ConditionGraph(net), inputs),
    }
    if pipeline.place_encoder is not None and net.points_size:
        grid = pipeline.place_encoder.grid
        grids = grid.clip_m * torch.rand(2, *[grid.cells] * 3, generator=random)
        graphs["places"] = (PlaceGraph(pipeline.place_encoder), {"grids": grids})
    reports = {
        name: export_network(graph, example, path if name == "step" else part_path(path, name), format, MAX_ERROR)
        for name, (graph, example) in graphs.items()
    }
    write_sidecar(path, describe(pipeline, reports))
    return reports


def describe(pipeline: HMD2, reports: dict[str, ExportReport]) -> dict:
    """The sidecar: everything that running the networks needs. Rotations of the motion are 6D in `features.frame`."""
    net, features, schedule = pipeline.net, pipeline.features, pipeline.schedule
    if type(schedule).__name__ not in SCHEDULES:
        raise WearcapError(
            f"schedule {type(schedule).__name__} cannot be exported", expected=f"one of {', '.join(SCHEDULES)}"
        )
    return {
        **header("denoiser", reports["step"]),
        "parts": {name: file_entry(report) for name, report in reports.items() if name != "step"},
        "window": net.window,
        "fps": pipeline.fps,
        "sampler": {
            "steps": pipeline.steps,
            "stride": pipeline.advance,
            "eta": pipeline.eta,
            "spacing": pipeline.spacing,
            "guidance": pipeline.guidance,
            "inpaint": pipeline.inpaint,
            "fade": pipeline.fade,
            "lookahead": pipeline.lookahead,
            "live": pipeline.live,
            "use": list(pipeline.use),
        },
        "schedule": {"name": type(schedule).__name__, **vars(schedule)},
        "features": asdict(features),
        "condition_channels": condition_channels(features),
        "motion_channels": motion_channels(features, pipeline.skeleton),
        "motion_mean": net.motion_normalizer.mean.tolist(),
        "motion_scale": net.motion_normalizer.scale.tolist(),
        "condition_size": net.condition_size,
        "points_size": net.points_size,
        "image_size": net.image_size,
        "self_conditioning": net.self_conditioning,
        "image_encoder": pipeline.image_encoder,
        "grid": None if pipeline.place_encoder is None else asdict(pipeline.place_encoder.grid),
        "skeleton": skeleton_to_json(pipeline.skeleton),
    }


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


def motion_channels(features: HeadFeatures, skeleton: Skeleton) -> list[str]:
    """Names of the motion's channels in order."""
    feet = ["left_foot.contact", "right_foot.contact"] if features.contacts else []
    return [*(f"{joint}.{entry}" for joint in skeleton.joint_names for entry in ROT6D), *feet]


class ExportedDenoiser(MotionDenoiser):
    """A `MotionDenoiser` whose weights are in exported files, run on the CPU."""

    def __init__(self, step: Run, conditions: Run, about: dict):
        """`about`: the sidecar."""
        nn.Module.__init__(self)  # no blocks of its own
        self._run = step, conditions
        self.window, self.condition_size = about["window"], about["condition_size"]
        self.points_size, self.image_size = about["points_size"], about["image_size"]
        self.self_conditioning = about["self_conditioning"]
        self.motion_size = len(about["motion_mean"])
        self.motion_normalizer = Normalizer(self.motion_size)
        self.motion_normalizer.set(torch.tensor(about["motion_mean"]), torch.tensor(about["motion_scale"]))

    def encode(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Float[Tensor, "batch token width"]:
        inputs = {"head": conditions.head, "valid": valid}
        if self.points_size:
            inputs |= {"points": conditions.points, "points_valid": conditions.points_valid}
        if self.image_size:
            inputs |= {"image": conditions.image, "image_valid": conditions.image_valid}
        return self._run[1](**inputs)

    def plan(self, level: Float[Tensor, "batch #time"]) -> LevelPlan:
        """The exported step takes the level itself."""
        return LevelPlan(level[..., None], ())

    def step(
        self,
        x_t: Float[Tensor, "batch time motion"],
        plan: LevelPlan,
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        inputs = {"x_t": x_t, "level": plan.worth[..., 0].expand(len(x_t), 1), "encoded": encoded, "valid": valid}
        if self.self_conditioning:
            inputs["last"] = torch.zeros_like(x_t) if last is None else last
        return self._run[0](**inputs)


class ExportedPlaces(VoxelAutoencoder):
    """The encoder of the points around the body, with its weights in an exported file."""

    def __init__(self, run: Run, grid: VoxelGrid, size: int):
        nn.Module.__init__(self)
        self._run, self.grid, self.size = run, grid, size

    def encode(self, grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch feature"]:
        flat = grids.reshape(-1, *grids.shape[-3:])
        return self._run(grids=flat).reshape(*grids.shape[:-3], self.size)


def load_exported_hmd2(path: str | Path) -> HMD2:
    """The pipeline of an exported model, from the step's file (.onnx or .pt2) and the files beside it.

    Raises WearcapError when one of the files is missing, unreadable, or does not belong to the others.
    """
    step = open_exported(path)
    about = read_sidecar(path, "denoiser")
    parts = {name: open_exported(part_path(path, name)) for name in about["parts"]}
    places = None
    if "places" in parts:
        places = ExportedPlaces(parts["places"], VoxelGrid(**about["grid"]), about["points_size"])
    schedule = dict(about["schedule"])
    return HMD2(
        net=ExportedDenoiser(step, parts["conditions"], about),
        features=HeadFeatures(**about["features"]),
        schedule=SCHEDULES[schedule.pop("name")](**schedule),
        skeleton=skeleton_from_json(about["skeleton"]),
        fps=about["fps"],
        place_encoder=places,
        image_encoder=about["image_encoder"],
        **about["sampler"],
    )


def main(arguments: list[str]) -> None:
    """Capture the motion of one recording with an exported model and write it as a recording."""
    parser = command.parser("hmd2", main.__doc__, "a head stream", "the motion (.safetensors)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sampler's noise (default 0)")
    options = parser.parse_args(arguments)
    recording = RecordingFile(options.recording).load()
    motion = load_exported_hmd2(options.model)(recording, options.seed)
    captured = Recording(
        options.output.stem, motion=motion, skeleton=motion.skeleton, source=f"captured from {recording.name}"
    )
    save_recording(captured, options.output)
    print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {options.output}")


if __name__ == "__main__":
    command.run(main)
