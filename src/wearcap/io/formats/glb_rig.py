"""Characters in .glb and .vrm files: their bones as they stand, and the same file with an animation of them added.

Meshes, materials, skins, morph targets and extensions stay as they are; the file's own buffer grows by the animation's numbers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.boundary.limits import Budget
from wearcap.boundary.opening import read_bytes, understood
from wearcap.boundary.texts import parse_json, require_layout
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.io.formats.glb import DAMAGE, Accessor, Buffer, Node, View, accessor_values, glb_chunks
from wearcap.io.formats.gltf import Figure

ANIMATION = "wearcap"
"""Name of the animation; an older one of that name is replaced."""
_EVEN = 1e-3
"""Largest relative difference of the scales of a node's axes."""


class _RigNode(Node):
    name: str = ""
    skin: int | None = None


class _Skin(msgspec.Struct):
    joints: list[int]
    inverseBindMatrices: int | None = None


class _Primitive(msgspec.Struct):
    attributes: dict[str, int]


class _Surface(msgspec.Struct):
    primitives: list[_Primitive]


class _Tree(msgspec.Struct):
    nodes: list[_RigNode]
    skins: list[_Skin] = []
    meshes: list[_Surface] = []
    accessors: list[Accessor] = []
    bufferViews: list[View] = []
    buffers: list[Buffer] = []
    extensions: dict[str, Any] = {}


@dataclass(frozen=True)
class GlbRig:
    """The bones of a character in the bind pose of its skins, in the file's world (y up), parents first."""

    document: dict[str, Any]
    binary: bytes
    nodes: tuple[int, ...]
    """Node of each bone."""
    names: tuple[str, ...]
    """By VRM's humanoid, where the file has one: the others are then in brackets."""
    parents: tuple[int, ...]
    R_bind: Float64[Tensor, "bone 3 3"]
    t_bind: Float64[Tensor, "bone 3"]
    R_parent_bone: Float64[Tensor, "bone 3 3"]
    """Rotations that the file gives its nodes, which undriven bones keep."""
    T_world_parent: Float64[Tensor, "bone 4 4"]
    """Of the nodes as they stand, with their scales."""
    lowest: float | None
    """Height of the skinned meshes' lowest vertex in the bind pose, where they say it."""


def read_glb_rig(path: str | Path) -> GlbRig:
    """Read a character. Raises WearcapError for a file that is no .glb, is damaged, or has no bones."""
    data = read_bytes(path, "mesh")
    with understood("not a readable glTF file", path, "a whole .glb or .vrm file of a character", errors=DAMAGE):
        text, binary = glb_chunks(data)
        document = parse_json(text, path, "mesh")
        tree = require_layout(document, _Tree, path)
        Budget(path, "bvh").count(len(tree.nodes) // 16, "nodes")
        if tree.buffers and tree.buffers[0].uri is not None:
            raise ValueError("its numbers lie in another file")
        return _bones(tree, document, binary)


def _bones(tree: _Tree, document: dict[str, Any], binary: bytes) -> GlbRig:
    above = {child: node for node, each in enumerate(tree.nodes) for child in each.children}
    order: list[int] = []
    level = [node for node in range(len(tree.nodes)) if node not in above]
    while level:
        order += level
        level = [child for node in level for child in tree.nodes[node].children]
        if len(order) > len(tree.nodes):
            raise ValueError("nodes within nodes without end")
    inside = {joint for skin in tree.skins for joint in skin.joints}
    for node in order[::-1]:
        if node in inside and node in above:
            inside.add(above[node])
    kept = [node for node in order if node in inside or (not inside and tree.nodes[node].mesh is None)]
    if len(kept) < 2:
        raise ValueError("no bones")
    place = {node: bone for bone, node in enumerate(kept)}
    T_local = {node: tree.nodes[node].transform() for node in order}
    T_world: dict[int, np.ndarray] = {}
    for node in order:
        T_world[node] = T_world[above[node]] @ T_local[node] if node in above else T_local[node]
    T_parents = np.stack([T_world[above[node]] if node in above else np.eye(4) for node in kept])
    bind = _bind_poses(tree, binary, T_world)
    R_local = np.stack([_rotation(T_local[node]) for node in kept])
    R_bind, t_bind = np.empty_like(R_local), np.empty((len(kept), 3))
    parents = tuple(place[above[node]] if node in above else -1 for node in kept)
    for bone, (node, parent) in enumerate(zip(kept, parents)):
        R_above = np.eye(3) if parent < 0 else R_bind[parent]
        size = np.cbrt(np.linalg.det(T_parents[bone][:3, :3]))
        step = R_above @ (size * T_local[node][:3, 3])
        t_bind[bone] = step if parent < 0 else t_bind[parent] + step
        R_bind[bone] = bind[node] if node in bind else R_above @ R_local[bone]
    named = _humanoid(tree)
    names = [named.get(node) or (f"({tree.nodes[node].name})" if named else tree.nodes[node].name) for node in kept]
    arrays = (torch.from_numpy(each) for each in (R_bind, t_bind, R_local, T_parents))
    return GlbRig(document, binary, tuple(kept), tuple(names), parents, *arrays, _lowest(tree, binary, T_world))


def _rotation(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3 3"]:
    """The rotation of a node's matrix. Raises ValueError for one that shears, mirrors or stretches."""
    sizes = np.linalg.norm(T[:3, :3], axis=0)
    if not (np.isfinite(T).all() and sizes.min() > 1e-9 and np.ptp(sizes) <= _EVEN * sizes.max()):
        raise ValueError("a bone that is stretched along one axis")
    R = T[:3, :3] / sizes
    if np.abs(R.T @ R - np.eye(3)).max() > 10 * _EVEN or np.linalg.det(R) < 0:
        raise ValueError("a bone that is mirrored or sheared")
    return R


def _inverse_binds(tree: _Tree, binary: bytes, skin: _Skin) -> Float[np.ndarray, "joint 4 4"]:
    assert skin.inverseBindMatrices is not None
    values = accessor_values(tree, binary, skin.inverseBindMatrices, "MAT4").astype(np.float64)
    return values.reshape(-1, 4, 4).swapaxes(1, 2)


def _bind_poses(tree: _Tree, binary: bytes, T_world: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """World rotations of joints in their skins' bind pose, which is turned as the skin's first joint stands."""
    found: dict[int, np.ndarray] = {}
    for skin in tree.skins:
        if skin.inverseBindMatrices is None:
            continue
        inverse = _inverse_binds(tree, binary, skin)
        first = T_world[skin.joints[0]] @ inverse[0]
        for joint, matrix in zip(skin.joints, inverse):
            found.setdefault(joint, _rotation(first @ np.linalg.inv(matrix)))
    return found


def _lowest(tree: _Tree, binary: bytes, T_world: dict[int, np.ndarray]) -> float | None:
    heights = [np.inf]
    for node in tree.nodes:
        if node.mesh is None or node.skin is None or tree.skins[node.skin].inverseBindMatrices is None:
            continue
        skin = tree.skins[node.skin]
        T = T_world[skin.joints[0]] @ _inverse_binds(tree, binary, skin)[0]
        for part in tree.meshes[node.mesh].primitives:
            bounds = tree.accessors[part.attributes["POSITION"]]
            box = np.stack([np.array(bounds.min), np.array(bounds.max)], 1)
            corners = np.stack(np.meshgrid(*box), -1).reshape(-1, 3)
            heights.append((corners @ T[1, :3] + T[1, 3]).min())
    return float(min(heights)) if np.isfinite(min(heights)) else None


def _humanoid(tree: _Tree) -> dict[int, str]:
    """VRM's names of bones (`leftUpperLeg` …) by node, of its versions 0 and 1."""
    new, old = (tree.extensions.get(name, {}).get("humanoid", {}).get("humanBones") for name in ("VRMC_vrm", "VRM"))
    pairs = [(bone["node"], name) for name, bone in new.items()] if new else []
    pairs += [(bone["node"], bone["bone"]) for bone in old or []]
    return {node: name for node, name in pairs if isinstance(node, int) and isinstance(name, str)}


def write_glb_rig(
    rig: GlbRig,
    path: str | Path,
    timestamps: Float64[Tensor, "time"],
    R_parent_bone: dict[int, Float[Tensor, "time 3 3"]],
    t_parent_bone: dict[int, Float[Tensor, "time 3"]],
) -> None:
    """Write the character's file with an animation of these bones, the first of its animations.

    Raises WearcapError for numbers that are not finite, and for times that do not rise.
    """
    values = [*R_parent_bone.values(), *t_parent_bone.values(), timestamps]
    if not all(value.isfinite().all() for value in values) or not (timestamps.diff() > 0).all():
        raise WearcapError("the motion is not finite, or its timestamps repeat or fall", path, "finite poses in order")
    document = dict(rig.document)
    figure = Figure(timestamps[0].item())
    figure.binary += rig.binary
    figure.views, figure.accessors = list(document.get("bufferViews", [])), list(document.get("accessors", []))
    nodes = list(document["nodes"])
    for bone in {*R_parent_bone, *t_parent_bone}:
        nodes[rig.nodes[bone]] = _without_matrix(nodes[rig.nodes[bone]])
    rotations = {rig.nodes[bone]: R for bone, R in R_parent_bone.items()}
    figure.animate(timestamps, rotations, {rig.nodes[bone]: t for bone, t in t_parent_bone.items()})
    ours = {"name": ANIMATION, "samplers": figure.samplers, "channels": figure.channels}
    others = [each for each in document.get("animations", []) if each.get("name") != ANIMATION]
    figure.write(path, document | {"nodes": nodes, "animations": [ours, *others]})


def _without_matrix(node: dict[str, Any]) -> dict[str, Any]:
    """A node with translation, rotation and scale in place of its matrix: only these can be animated."""
    if "matrix" not in node:
        return node
    T = np.array(node["matrix"], np.float64).reshape(4, 4).T
    R = _rotation(T)
    wxyz = quat_wxyz_from_matrix(torch.from_numpy(R)).tolist()
    parts = {
        "translation": T[:3, 3].tolist(),
        "rotation": [*wxyz[1:], wxyz[0]],
        "scale": np.linalg.norm(T[:3, :3], axis=0).tolist(),
    }
    return {key: value for key, value in node.items() if key != "matrix"} | parts
