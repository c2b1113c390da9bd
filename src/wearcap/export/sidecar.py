"""What a denoiser's file does not say: statistics, sampler, features, skeleton. JSON, written beside it."""

import json
from dataclasses import asdict
from pathlib import Path

import torch

from wearcap.body.skeleton import Site, Skeleton
from wearcap.data.features import HeadFeatures
from wearcap.diffusion.schedule import CosineSchedule, LinearSchedule
from wearcap.errors import WearcapError
from wearcap.export.network import ExportReport, export_network
from wearcap.files import sha256_of, write_text
from wearcap.pipelines.hmd2 import HMD2

VERSION = 1
MAX_ERROR = 1e-4
SCHEDULES = {cls.__name__: cls for cls in (CosineSchedule, LinearSchedule)}
ROT6D = tuple(f"{column}{axis}" for column in "xy" for axis in "xyz")
"""First two columns of a rotation matrix, one after the other."""


def export_hmd2(pipeline: HMD2, path: str | Path, format: str) -> ExportReport:
    """Write the pipeline's denoiser as `path` (.onnx or .pt2) and its sidecar as the same name with .json.

    Raises what `export_network` raises.
    """
    net, random = pipeline.net, torch.Generator().manual_seed(0)
    level = torch.rand(2, net.window, generator=random)
    valid = torch.arange(net.window).expand(2, -1) < net.window - 3
    x_t = torch.randn(2, net.window, net.motion_size, generator=random)
    scale = net.condition_normalizer.scale.cpu()
    condition = net.condition_normalizer.mean.cpu() + scale * torch.randn(
        2, net.window, len(scale), generator=random
    )
    example = {"x_t": x_t, "level": level, "condition": condition, "valid": valid}
    report = export_network(net, example, path, format, MAX_ERROR)
    write_sidecar(path, describe(pipeline, report))
    return report


def sidecar_path(path: str | Path) -> Path:
    return Path(path).with_suffix(".json")


def write_sidecar(path: str | Path, about: dict) -> None:
    write_text(sidecar_path(path), json.dumps(about, indent=1) + "\n")


def describe(pipeline: HMD2, report: ExportReport) -> dict:
    """Everything a runner needs beside the network. Rotations of the motion are 6D in `features.frame`."""
    net, features, schedule = pipeline.net, pipeline.features, pipeline.schedule
    if type(schedule).__name__ not in SCHEDULES:
        raise WearcapError(f"schedule {type(schedule).__name__} cannot be exported",
                           expected=f"one of {', '.join(SCHEDULES)}")  # fmt: skip
    return {
        **header("denoiser", report),
        "window": net.window,
        "fps": pipeline.fps,
        "sampler": {"steps": pipeline.steps, "stride": pipeline.advance, "eta": pipeline.eta},
        "schedule": {"name": type(schedule).__name__, **vars(schedule)},
        "features": asdict(features),
        "condition_channels": condition_channels(features),
        "motion_channels": [f"{joint}.{entry}" for joint in pipeline.skeleton.joint_names for entry in ROT6D],
        "motion_mean": net.motion_normalizer.mean.tolist(),
        "motion_scale": net.motion_normalizer.scale.tolist(),
        "condition_size": net.condition_size,
        "skeleton": skeleton_to_json(pipeline.skeleton),
    }


def header(network: str, report: ExportReport) -> dict:
    """What the sidecar of every kind of network begins with."""
    model = {"file": Path(report.path).name, "sha256": sha256_of(report.path), **asdict(report)}
    return {"wearcap_export": VERSION, "network": network, "model": model}


def condition_channels(features: HeadFeatures) -> list[str]:
    """Names of the condition's channels in order; it enters the network raw."""
    horizontal = ["offset_x", "offset_y"] if features.frame == "window" else []
    return [
        *horizontal, f"height_{features.height}", *(f"head.{entry}" for entry in ROT6D),
        *(f"velocity_{axis}" for axis in "xyz"), *(f"angular_velocity_{axis}" for axis in "xyz"),
    ]  # fmt: skip


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
        raise WearcapError(f"not a readable sidecar ({error})", where=sidecar) from error
    if not isinstance(tree, dict) or tree.get("wearcap_export") != VERSION:
        raise WearcapError("not a sidecar of this version", where=sidecar, fix="Export the model again.")
    # The first sidecars did not say: all were denoisers'.
    if (kind := tree.get("network", "denoiser")) != network:
        raise WearcapError(f"a {kind} network", where=path, expected=f"a {network} network")
    if tree["model"]["sha256"] != sha256_of(path):
        raise WearcapError(
            "its sidecar belongs to another model file", where=path, fix="Export the model again."
        )
    return tree
