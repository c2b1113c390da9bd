"""What a denoiser's file does not say: statistics, sampler, features, skeleton. JSON, written beside it."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.body.skeleton import Site, Skeleton
from wearcap.data.features import LIMBS, HeadFeatures
from wearcap.diffusion.schedule import CosineSchedule, LinearSchedule
from wearcap.errors import WearcapError
from wearcap.export.network import ExportReport, export_network
from wearcap.files import sha256_of, write_text
from wearcap.models.denoiser import Conditions, MotionDenoiser
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.pipelines.hmd2 import HMD2

VERSION = 4
MAX_ERROR = 1e-4
SCHEDULES = {cls.__name__: cls for cls in (CosineSchedule, LinearSchedule)}
ROT6D = tuple(f"{column}{axis}" for column in "xy" for axis in "xyz")
"""First two columns of a rotation matrix, one after the other."""


class ConditionGraph(nn.Module):
    """What of a denoiser is computed once per window."""

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
        told = Conditions(
            head, none if points is None else points, valid if points_valid is None else points_valid,
            none if image is None else image, valid if image_valid is None else image_valid,
        )  # fmt: skip
        return self.net.encode(told, valid)


class PlaceGraph(nn.Module):
    """Codes of grids (m) of the points around the body."""

    def __init__(self, encoder: VoxelAutoencoder):
        super().__init__()
        self.encoder = encoder

    def forward(self, grids: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch feature"]:
        return self.encoder.encode(grids)


def export_hmd2(pipeline: HMD2, path: str | Path, format: str) -> dict[str, ExportReport]:
    """Write the pipeline's networks in a format, .onnx or .pt2, and a sidecar of `path`'s name with .json.

    `path` is the step (x_t, level, encoded, valid, and last with self-conditioning); NAME.conditions makes `encoded`
    once per window; NAME.places, where the network listens to points, codes of the grids around the body. Reports by
    these names. Raises what `export_network` raises.
    """
    net, random, path = pipeline.net, torch.Generator().manual_seed(0), Path(path)
    shape = 2, net.window
    valid = torch.arange(net.window).expand(2, -1) < net.window - 3
    normalizer = net.condition_encoder.normalizer
    noise = torch.randn(*shape, len(normalizer.scale), generator=random)
    conditions = {"head": normalizer.mean.cpu() + normalizer.scale.cpu() * noise, "valid": valid}
    for name, size in (("points", net.points_size), ("image", net.image_size)):
        if size:
            there = valid & (torch.rand(shape, generator=random) < 0.7)
            conditions |= {name: torch.randn(*shape, size, generator=random), f"{name}_valid": there}
    tokens, width = net.window // net.frames_per_token, net.motion_encoder.linear.out_features
    x_t, last = torch.randn(2, *shape, net.motion_size, generator=random)
    step = {
        "x_t": x_t, "level": torch.rand(2, 1, generator=random),
        "encoded": torch.randn(2, tokens, width, generator=random), "valid": valid,
    }  # fmt: skip
    graphs = {
        "step": (net, step | ({"last": last} if net.self_conditioning else {})),
        "conditions": (ConditionGraph(net), conditions),
    }
    if pipeline.place_encoder is not None and net.points_size:
        grid = pipeline.place_encoder.grid
        grids = grid.clip_m * torch.rand(2, *[grid.cells] * 3, generator=random)
        graphs["places"] = (PlaceGraph(pipeline.place_encoder), {"grids": grids})
    reports = {
        name: export_network(
            graph, example, path if name == "step" else part_path(path, name), format, MAX_ERROR
        )
        for name, (graph, example) in graphs.items()
    }
    write_sidecar(path, describe(pipeline, reports))
    return reports


def part_path(path: str | Path, part: str) -> Path:
    """File of a part that lies beside the step's."""
    path = Path(path)
    return path.with_name(f"{path.stem}.{part}{path.suffix}")


def sidecar_path(path: str | Path) -> Path:
    return Path(path).with_suffix(".json")


def write_sidecar(path: str | Path, about: dict) -> None:
    write_text(sidecar_path(path), json.dumps(about, indent=1) + "\n")


def describe(pipeline: HMD2, reports: dict[str, ExportReport]) -> dict:
    """Everything a runner needs beside the networks. Rotations of the motion are 6D in `features.frame`."""
    net, features, schedule = pipeline.net, pipeline.features, pipeline.schedule
    if type(schedule).__name__ not in SCHEDULES:
        raise WearcapError(f"schedule {type(schedule).__name__} cannot be exported",
                           expected=f"one of {', '.join(SCHEDULES)}")  # fmt: skip
    return {
        **header("denoiser", reports["step"]),
        "parts": {name: _file(report) for name, report in reports.items() if name != "step"},
        "window": net.window,
        "fps": pipeline.fps,
        "sampler": {
            "steps": pipeline.steps,
            "stride": pipeline.advance,
            "eta": pipeline.eta,
            "spacing": pipeline.spacing,
            "guidance": pipeline.guidance,
            "hold": pipeline.hold,
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


def header(network: str, report: ExportReport) -> dict:
    """What the sidecar of every kind of network begins with."""
    return {"wearcap_export": VERSION, "network": network, "model": _file(report)}


def _file(report: ExportReport) -> dict:
    return {"file": Path(report.path).name, "sha256": sha256_of(report.path), **asdict(report)}


def condition_channels(features: HeadFeatures) -> list[str]:
    """Names of the head's channels in order; they enter the network raw."""
    horizontal = ["offset_x", "offset_y"] if features.frame == "window" else []
    return [
        *horizontal, f"height_{features.height}", *(f"head.{entry}" for entry in ROT6D),
        *(f"velocity_{axis}" for axis in "xyz"), *(f"angular_velocity_{axis}" for axis in "xyz"),
        *(f"size.{limb}" for limb in LIMBS if features.body),
    ]  # fmt: skip


def motion_channels(features: HeadFeatures, skeleton: Skeleton) -> list[str]:
    """Names of the motion's channels in order."""
    feet = ["left_foot.contact", "right_foot.contact"] if features.contacts else []
    return [*(f"{joint}.{entry}" for joint in skeleton.joint_names for entry in ROT6D), *feet]


def skeleton_to_json(skeleton: Skeleton) -> dict:
    return {
        "name": skeleton.name,
        "joint_names": skeleton.joint_names,
        "parents": skeleton.parents,
        "t_parent_joint": skeleton.t_parent_joint.tolist(),
        "sites": {name: [site.joint, *site.t_joint_site] for name, site in skeleton.sites.items()},
    }


def skeleton_from_json(tree: dict) -> Skeleton:
    sites = {name: Site(joint, (x, y, z)) for name, (joint, x, y, z) in tree["sites"].items()}
    return Skeleton(
        tree["name"], tuple(tree["joint_names"]), tuple(tree["parents"]), torch.tensor(tree["t_parent_joint"]), sites
    )  # fmt: skip


def read_sidecar(path: str | Path, network: str) -> dict:
    """The sidecar of a model file. Raises WearcapError when it is missing, foreign, or of another network or file."""
    sidecar = sidecar_path(path)
    try:
        tree = json.loads(sidecar.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise WearcapError("no such sidecar", where=sidecar, expected="the .json file that `wearcap export` wrote "
                           "beside the model", fix="Copy both files.") from error  # fmt: skip
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise WearcapError(
            f"not a readable sidecar ({error})", where=sidecar, fix="Export the model again."
        ) from error
    if not isinstance(tree, dict) or tree.get("wearcap_export") != VERSION:
        raise WearcapError("not a sidecar of this version", where=sidecar, fix="Export the model again.")
    # The first sidecars did not say: all were denoisers'.
    if (kind := tree.get("network", "denoiser")) != network:
        raise WearcapError(f"a {kind} network", where=path, expected=f"a {network} network")
    files = {Path(path): tree["model"]} | {
        part_path(path, name): part for name, part in tree.get("parts", {}).items()
    }
    for file, part in files.items():
        if not file.is_file():
            raise WearcapError("a part of the exported model is missing", where=file, fix="Copy all files of the export.")  # fmt: skip
        if part["sha256"] != sha256_of(file):
            raise WearcapError("its sidecar belongs to another model file", where=file, fix="Export the model again.")  # fmt: skip
    return tree
