"""Interactive environments as files: `environment.json` beside its objects' meshes (docs/environments.md)."""

import json
import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.boundary.limits import Budget
from wearcap.boundary.opening import path_inside, placed
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.ply import Ply, read_ply, write_ply
from wearcap.io.formats.poses import are_rotations
from wearcap.scene.objects import FREEDOMS, Environment, Freedom, SceneObject

SCHEMA = 1
FILE_NAME = "environment.json"
MAX_HINGE_GAP_M = 0.5
"""Largest horizontal distance (m) of a hinge from its object's bounding box."""

_KEYS = ("name", "category", "mesh", "R_world_object", "t_world_object", "freedom")
_FREEDOM_KEYS = {
    "plane": ("kind",),
    "free": ("kind",),
    "hinge": ("kind", "pivot", "limits_deg"),
    "axis": ("kind", "axis", "limits_m"),
}
_OPTIONAL = ("limits_deg", "limits_m")
_ORTHOGONAL_WITHIN = 1e-3
_LARGEST = float(np.finfo(np.float32).max)


def read_environment(path: str | Path) -> Environment:
    """Read an environment.json, or the one in a folder, with the meshes that it names.

    Raises WearcapError for damaged JSON, another version, unknown or missing keys, a missing mesh, names that repeat,
    numbers that are not finite, matrices that are no rotations, reversed limits, and a hinge far from its mesh.
    """
    path = Path(path)
    path = path / FILE_NAME if path.is_dir() else path
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("objects"), list):
        raise WearcapError("not an environment", path, '{"schema_version": 1, "objects": […]}')
    if content.get("schema_version") != SCHEMA:
        fix = "Read it with the wearcap that wrote it, or update."
        raise WearcapError(f"schema version {content.get('schema_version')!r}", path, str(SCHEMA), fix)
    _require_keys(content, ("schema_version", "objects"), path)
    budget = Budget(path, "environment")
    budget.count(len(content["objects"]), "objects")
    read = cache(lambda file: _mesh(file, path))  # once, however many objects have it
    objects, points = [], Budget(path, "mesh")
    for number, row in enumerate(content["objects"]):
        objects.append(_object(row, number, path, read))
        points.spend(objects[-1].mesh.vertices.nbytes)  # whoever moves or shows objects takes them one by one
    with placed(path):
        return Environment(tuple(objects))


def write_environment(environment: Environment, path: str | Path) -> None:
    """Write environment.json (`path`, or in that folder) and objects/NAME.ply; the list last, each file atomically.

    Meshes keep colours of 8 bits. Raises WearcapError for anything that `read_environment` refuses.
    """
    path = Path(path)
    path = path if path.suffix == ".json" else path / FILE_NAME
    rows, taken = [], set()
    for item in environment.objects:
        where = f"{path}: object {item.name!r}"
        _check(item, where)
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", item.name).strip("_")[:60] or "object"
        if re.fullmatch(r"(?i)con|prn|aux|nul|com\d|lpt\d", plain):
            plain = f"{plain}_"
        free, number = plain, 2
        while free.lower() in taken:
            free, number = f"{plain}-{number}", number + 1
        taken.add(free.lower())
        rows.append(_row(item, f"objects/{free}.ply", where))
    for item, row in zip(environment.objects, rows):
        write_ply(Ply.of(item.mesh), path.parent / row["mesh"])
    lines = ",\n  ".join(json.dumps(row, ensure_ascii=False, allow_nan=False) for row in rows)
    write_text(path, f'{{"schema_version": {SCHEMA}, "objects": [\n  {lines}\n]}}\n')


def _object(row: Any, number: int, path: Path, read: Callable[[Path], Mesh]) -> SceneObject:
    named = isinstance(row, dict) and isinstance(row.get("name"), str) and row["name"].strip()
    where = f"{path}: object {row['name']!r}" if named else f"{path}: object {number}"
    if not named:
        raise WearcapError("an object without a name", where, f"an object with {', '.join(_KEYS)}")
    if row.get("freedom") is None:
        fix = "What cannot move belongs to the scan and not among the objects."
        raise WearcapError("no degree of freedom", where, f'"freedom": {{"kind": one of {", ".join(FREEDOMS)}}}', fix)
    _require_keys(row, _KEYS, where)
    if not isinstance(row["category"], str):
        raise WearcapError(f"category {row['category']!r}", where, "text")
    R = _rotation(row["R_world_object"], where).float()
    t = torch.from_numpy(_numbers(row["t_world_object"], (3,), "t_world_object", where)).float()
    mesh = read(path_inside(path.parent, row["mesh"], where))
    about = row["freedom"]
    kind = about.get("kind") if isinstance(about, dict) else None
    if kind not in tuple(FREEDOMS):  # a file may say anything, lists too
        raise WearcapError(f"no degree of freedom {kind!r}", where, f"one of {', '.join(FREEDOMS)}")
    _require_keys(about, _FREEDOM_KEYS[kind], f"{where}, freedom")
    pivot = None if kind != "hinge" else tuple(_numbers(about["pivot"], (3,), "pivot", where).tolist())
    axis = None if kind != "axis" else tuple(_numbers(about["axis"], (3,), "axis", where).tolist())
    limits = None
    if (key := _FREEDOM_KEYS[kind][-1]) in about and key in _OPTIONAL and about[key] is not None:
        limits = _numbers(about[key], (2,), key, where)
        if limits[0] > limits[1]:
            raise WearcapError(f"{key} {limits.tolist()} are reversed", where, "[least, greatest]")
        limits = tuple((np.radians(limits) if key == "limits_deg" else limits).tolist())
    with placed(where):
        freedom = Freedom(kind, pivot, axis, limits)
    item = SceneObject(row["name"], row["category"], mesh, R, t, freedom)
    _check(item, where)
    return item


def _mesh(file: Path, path: Path) -> Mesh:
    if not file.is_file():
        fix = "Copy the folder objects/ together with the environment."
        raise WearcapError(f"its mesh {file.relative_to(path.parent)} is missing", path, str(file), fix)
    mesh = read_ply(file).mesh
    if not len(mesh.vertices):
        raise WearcapError("an empty mesh", file, "at least one point")
    return mesh


def _row(item: SceneObject, mesh: str, where: str) -> dict[str, Any]:
    freedom, limits = item.freedom, item.freedom.limits
    row: dict[str, Any] = {"kind": freedom.kind}
    if freedom.pivot is not None:
        row["pivot"] = list(freedom.pivot)
    if freedom.axis is not None:
        row["axis"] = list(freedom.axis)
    if limits is not None and freedom.kind not in ("hinge", "axis"):
        what = f"limits of an object that is {freedom.kind!r}"
        raise WearcapError(what, where, "limits of hinges and of slides along an axis alone")
    if limits is not None:
        hinge = freedom.kind == "hinge"
        row["limits_deg" if hinge else "limits_m"] = [math.degrees(v) if hinge else v for v in limits]
    # The fewest digits that identify a single-precision number.
    lines = (*item.R_world_object.tolist(), item.t_world_object.tolist())
    *R, t = [[float(f"{v:.9g}") for v in line] for line in lines]
    return dict(zip(_KEYS, (item.name, item.category, mesh, R, t, row)))


def _check(item: SceneObject, where: str) -> None:
    """Raise WearcapError for properties that no object can have."""
    pose = [*item.R_world_object.flatten().tolist(), *item.t_world_object.tolist()]
    freedom = [*(item.freedom.pivot or ()), *(item.freedom.axis or ()), *(item.freedom.limits or ())]
    if not item.name.strip() or not len(item.mesh.vertices):
        raise WearcapError("no name, or no points", where, "a named object with a mesh or a cloud")
    if not (np.isfinite([*pose, *freedom]).all() and np.isfinite(item.mesh.vertices).all()):
        raise WearcapError("numbers that are not finite", where, "finite coordinates (m)")
    _rotation(item.R_world_object.tolist(), where)
    gap = item.hinge_gap_m
    if gap > MAX_HINGE_GAP_M:
        what = f"its hinge is {gap:.2f} m from its mesh, seen from above"
        raise WearcapError(what, where, f"at most {MAX_HINGE_GAP_M} m", "The pivot is a point of the world, in metres.")


def _rotation(value: Any, where: str) -> Float64[Tensor, "3 3"]:
    """The rotation nearest to a matrix that is a rotation up to rounding."""
    R = torch.from_numpy(_numbers(value, (3, 3), "R_world_object", where))
    if not are_rotations(R, _ORTHOGONAL_WITHIN):
        expected = f"an orthogonal matrix (within {_ORTHOGONAL_WITHIN}) of determinant +1"
        raise WearcapError("R_world_object is no rotation", where, expected)
    return rotation.mean_rotation(R[None])


def _numbers(value: Any, shape: tuple[int, ...], key: str, where: str) -> Float64[np.ndarray, "..."]:
    expected = f"{' x '.join(map(str, shape))} finite numbers"
    leaves = np.array(value, dtype=object) if isinstance(value, list) else np.array(None)
    plain = leaves.shape == shape and all(type(leaf) in (int, float) for leaf in leaves.flat)
    if not plain or not all(abs(leaf) < _LARGEST for leaf in leaves.flat):
        raise WearcapError(f"{key} is {value!r}"[:200], where, expected)
    return leaves.astype(np.float64)


def _require_keys(row: dict, keys: tuple[str, ...], where: str | Path) -> None:
    if unknown := sorted(set(row) - set(keys)):
        raise WearcapError(f"unknown key {unknown[0]!r}", where, f"only {', '.join(keys)}")
    if missing := [key for key in keys if key not in row and key not in _OPTIONAL]:
        raise WearcapError(f"no {missing[0]!r}", where, ", ".join(keys))
