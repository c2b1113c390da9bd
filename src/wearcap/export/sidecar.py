"""The sidecar of an exported network: a JSON file beside it with statistics, features, skeleton and more."""

import json
from dataclasses import asdict
from pathlib import Path

import torch

from wearcap.body.skeleton import Site, Skeleton
from wearcap.diffusion.schedule import CosineSchedule, LinearSchedule
from wearcap.errors import WearcapError
from wearcap.export.network import ExportReport
from wearcap.files import parse_json, sha256_of, write_text

VERSION = 5
SCHEDULES = {cls.__name__: cls for cls in (CosineSchedule, LinearSchedule)}
ROT6D = tuple(f"{column}{axis}" for column in "xy" for axis in "xyz")
"""First two columns of a rotation matrix, one after the other."""


def part_path(path: str | Path, part: str) -> Path:
    """Path of another part's file, beside the step's file."""
    path = Path(path)
    return path.with_name(f"{path.stem}.{part}{path.suffix}")


def sidecar_path(path: str | Path) -> Path:
    return Path(path).with_suffix(".json")


def write_sidecar(path: str | Path, about: dict) -> None:
    write_text(sidecar_path(path), json.dumps(about, indent=1) + "\n")


def header(network: str, report: ExportReport) -> dict:
    """The first entries of every network's sidecar."""
    return {"wearcap_export": VERSION, "network": network, "model": file_entry(report)}


def file_entry(report: ExportReport) -> dict:
    """Entry of a model file: its name, its checksum, and its export report."""
    return {"file": Path(report.path).name, "sha256": sha256_of(report.path), **asdict(report)}


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
    )


def read_sidecar(path: str | Path, network: str) -> dict:
    """The sidecar of a model file. Raises WearcapError when it is missing, foreign, or of another network or file."""
    sidecar = sidecar_path(path)
    try:
        tree = parse_json(sidecar.read_bytes(), sidecar)
    except FileNotFoundError as error:
        raise WearcapError(
            "no such sidecar",
            where=sidecar,
            expected="the .json file that `wearcap export` wrote beside the model",
            fix="Copy both files.",
        ) from error
    if not isinstance(tree, dict) or tree.get("wearcap_export") != VERSION:
        raise WearcapError("not a sidecar of this version", where=sidecar, fix="Export the model again.")
    # The first sidecars had no "network" entry: all were denoisers'.
    if (kind := tree.get("network", "denoiser")) != network:
        raise WearcapError(f"a {kind} network", where=path, expected=f"a {network} network")
    files = {Path(path): tree["model"]} | {part_path(path, name): part for name, part in tree.get("parts", {}).items()}
    for file, part in files.items():
        if not file.is_file():
            raise WearcapError(
                "a part of the exported model is missing", where=file, fix="Copy all files of the export."
            )
        if part["sha256"] != sha256_of(file):
            raise WearcapError("its sidecar belongs to another model file", where=file, fix="Export the model again.")
    return tree
