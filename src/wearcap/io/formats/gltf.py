"""Motion as glTF 2.0 binary (.glb): an animated, skinned figure that Blender and web viewers open.

One node per joint, with wearcap's axes and offsets, below a node that turns z up into glTF's y up. The inverse bind
matrices undo the rest pose with the root at the origin, the pose of a body's vertices. Without a body model, sticks stand
for its bones. How sure the motion is of its joints lies in the animation's `extras`.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int
from torch import Tensor

from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.body.skeletons import FINGER_JOINTS
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.recording.motion import Motion

_Z_UP_XYZW = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Rotation of z up into glTF's y up."""

_COMPONENT = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_TYPE = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_VERTICES, _INDICES = 34962, 34963
_MATERIAL = {
    "name": "skin",
    "doubleSided": True,
    "pbrMetallicRoughness": {"baseColorFactor": [0.62, 0.68, 0.76, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7},
}
_THICK_M, _THIN_M = 0.022, 0.012
_FINGER_M = 0.008
"""Radii (m) of a stick at its start and its end, and of fingers' bones."""

_GREY = np.full(3, 0.7, np.float32)


@dataclass(frozen=True)
class SkinnedMesh:
    """A mesh in the rest pose (m, wearcap's axes, root at the origin), with up to four weighted joints per vertex."""

    mesh: Mesh
    joints: Int[np.ndarray, "vertex 4"]
    weights: Float32[np.ndarray, "vertex 4"]
    rest_joints: Float[Tensor, "joint 3"]

    @property
    def normals(self) -> Float32[np.ndarray, "vertex 3"]:
        """Unit normals; upwards at vertices without a face, for glTF wants every one of unit length."""
        normals = self.mesh.vertex_normals
        loose = np.linalg.norm(normals, axis=-1, keepdims=True) < 0.5
        return np.where(loose, np.float32([0, 0, 1]), normals).astype(np.float32)

    @classmethod
    def of_body(cls, body: BodyModel, skeleton: Skeleton) -> "SkinnedMesh":
        """A body model's skin. Raises WearcapError when the motion's skeleton has other joints than the body."""
        if body.skeleton.joint_names != skeleton.joint_names:
            what = f"the motion has skeleton {skeleton.name!r}, the body {body.skeleton.name!r}"
            expected = "the same joints"
            raise WearcapError(what, expected=expected, fix="Make the body for the motion's skeleton, or retarget.")
        mesh = Mesh(body.rest_vertices.float().numpy(), body.faces.int().numpy(), _GREY, smooth=True)
        weights = body.skin_weights.float().numpy()
        # Joints without weight must be named as joint 0.
        joints = np.where(weights > 0, body.skin_joints.numpy(), 0)
        return cls(mesh, joints, weights / weights.sum(-1, keepdims=True), body.skeleton.rest_joints)

    @classmethod
    def sticks(cls, skeleton: Skeleton) -> "SkinnedMesh":
        """A rounded stick along every bone and out to every site; each moves with the joint it starts from."""
        bones = [(parent, skeleton.t_parent_joint[joint]) for joint, parent in enumerate(skeleton.parents) if joint]
        bones += [(skeleton.index(site.joint), torch.tensor(site.t_joint_site)) for site in skeleton.sites.values()]
        bones.append((0, torch.zeros(3)))
        owners = np.array([joint for joint, _ in bones])
        start = skeleton.rest_joints.double().numpy()[owners]
        end = start + torch.stack([offset for _, offset in bones]).double().numpy()
        slim = np.isin(np.array(skeleton.joint_names)[owners], FINGER_JOINTS)
        radii = (np.where(slim, _FINGER_M, radius) for radius in (_THICK_M, _THIN_M))
        mesh = capsules(start, end, *radii, np.tile(_GREY, (len(bones), 1)), 8)
        joints = np.zeros((len(mesh.vertices), 4), dtype=np.int64)
        joints[:, 0] = np.repeat(owners, len(mesh.vertices) // len(bones))
        weights = np.zeros((len(mesh.vertices), 4), dtype=np.float32)
        weights[:, 0] = 1
        return cls(mesh, joints, weights, skeleton.rest_joints)


def require_drawable(motion: Motion, path: str | Path) -> None:
    """Raise WearcapError for a motion that is empty, not finite or not rising in time, in itself or in its objects."""
    tracks = (motion.object_motion or {}).values()
    clocks = [motion.timestamps, *(track.timestamps for track in tracks if len(track))]
    values = [motion.R_parent_joint, motion.t_world_root]
    values += [v for track in tracks for v in (track.R_world_body, track.t_world_body)]
    if len(motion) == 0 or not all(value.isfinite().all() for value in (*values, *clocks)):
        raise WearcapError("the motion is empty or holds NaN or infinite values", path, "finite poses")
    if not all((clock.diff() > 0).all() for clock in clocks):
        raise WearcapError("timestamps repeat or fall", path, "rising timestamps")


def write_glb(motion: Motion, path: str | Path, body: BodyModel | None = None) -> None:
    """Write a motion and its body as .glb; without a body, sticks stand for the bones. Objects become empty nodes.

    Animation time starts at 0. Raises WearcapError for a motion that is empty, not finite or not rising in time, and
    for a body with other joints.
    """
    require_drawable(motion, path)
    tracks = motion.object_motion or {}
    clocks = [motion.timestamps, *(track.timestamps for track in tracks.values() if len(track))]
    joints = len(motion.skeleton)
    shown = SkinnedMesh.sticks(motion.skeleton) if body is None else SkinnedMesh.of_body(body, motion.skeleton)
    figure = Figure(start_s=min(clock[0].item() for clock in clocks))
    figure.add_joints(motion)
    figure.animate(motion.timestamps, dict(enumerate(motion.R_parent_joint.unbind(1), 1)), {1: motion.t_world_root})
    for name, track in tracks.items():
        if len(track):
            figure.nodes[0]["children"].append(len(figure.nodes))
            figure.nodes.append({"name": name})
            node = len(figure.nodes) - 1
            figure.animate(track.timestamps, {node: track.R_world_body}, {node: track.t_world_body})
    skin = {"joints": list(range(1, 1 + joints)), "skeleton": 1, "inverseBindMatrices": figure.inverse_bind(shown)}
    figure.nodes.append({"name": "body", "mesh": 0, "skin": 0})
    document = {
        "asset": {"version": "2.0", "generator": "wearcap", "extras": dict(motion.provenance)},
        "scene": 0,
        "scenes": [{"nodes": [0, len(figure.nodes) - 1]}],
        "nodes": figure.nodes,
        "meshes": [{"name": "body", "primitives": [figure.primitive(shown)]}],
        "materials": [_MATERIAL],
        "skins": [skin],
        "animations": [
            {"name": "motion", "samplers": figure.samplers, "channels": figure.channels} | _certainty(motion)
        ],
    }
    figure.write(path, document)


def _certainty(motion: Motion) -> dict[str, Any]:
    """`extras` with how sure the motion is of its joints, which glTF has no place for: whole millimetres of `joint_std` by joint, one for
    each key frame of the rotations, and `joint_dof`; nothing of a motion that does not say."""
    if motion.joint_std is None:
        return {}
    columns = (1000 * motion.joint_std.T).round().int().tolist()
    by_joint = dict(zip(motion.skeleton.joint_names, columns))
    return {"extras": {"joint_std_mm": by_joint, "joint_dof": motion.joint_dof}}


def quats_xyzw(R: Float[Tensor, "element 3 3"]) -> Float32[np.ndarray, "element 4"]:
    """Unit quaternions that never flip their sign from one element to the next."""
    xyzw = rotation.quat_wxyz_from_matrix(R.double()).roll(-1, dims=-1).numpy()
    flips = np.cumprod(np.where((xyzw[1:] * xyzw[:-1]).sum(-1) < 0, -1.0, 1.0))
    xyzw[1:] *= flips[:, None]
    return xyzw.astype(np.float32)


class Figure:
    """The growing document: nodes, animation, and the binary chunk with the accessors that describe it."""

    def __init__(self, start_s: float):
        self.start_s = start_s
        self.binary = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.nodes: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []

    def add_joints(self, motion: Motion) -> None:
        """Node 0 turns the axes; joint k of the skeleton is node k + 1, posed as in the first frame."""
        skeleton, quat_xyzw = motion.skeleton, quats_xyzw(motion.R_parent_joint[0]).tolist()
        offsets = skeleton.t_parent_joint.tolist()
        offsets[0] = motion.t_world_root[0].tolist()
        self.nodes.append({"name": "z_up", "rotation": _Z_UP_XYZW, "children": [1]})
        for joint, name in enumerate(skeleton.joint_names):
            self.nodes.append({"name": name, "translation": offsets[joint], "rotation": quat_xyzw[joint]})
            children = [1 + child for child, parent in enumerate(skeleton.parents) if parent == joint]
            if children:
                self.nodes[-1]["children"] = children

    def add(self, array: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Append one array, a row per element, with its bounds where the format wants them; returns its accessor."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.binary += np.ascontiguousarray(array).tobytes()
        accessor = {
            "bufferView": len(self.views) - 1,
            "componentType": _COMPONENT[array.dtype.name],
            "count": len(array),
            "type": _TYPE[array.shape[1:]],
        }
        if bounds:
            accessor |= {"min": np.atleast_1d(array.min(0)).tolist(), "max": np.atleast_1d(array.max(0)).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def animate(
        self,
        timestamps: Float64[Tensor, "time"],
        R: dict[int, Float[Tensor, "time 3 3"]],
        t: dict[int, Float[Tensor, "time 3"]],
    ) -> None:
        """Key frames of nodes' rotations and translations on one clock."""
        time = self.add((timestamps - self.start_s).float().numpy(), bounds=True)
        keys = [(node, "translation", value.float().numpy()) for node, value in t.items()]
        keys += [(node, "rotation", quats_xyzw(value)) for node, value in R.items()]
        for node, path, values in keys:
            self.channels.append({"sampler": len(self.samplers), "target": {"node": node, "path": path}})
            self.samplers.append({"input": time, "output": self.add(values), "interpolation": "LINEAR"})

    def inverse_bind(self, skin: SkinnedMesh) -> int:
        """Accessor of the matrices that bring rest vertices into each joint's frame (column-major)."""
        matrices = np.tile(np.eye(4, dtype=np.float32), (len(skin.rest_joints), 1, 1))
        matrices[:, 3, :3] = -skin.rest_joints.float().numpy()
        return self.add(matrices)

    def primitive(self, skin: SkinnedMesh) -> dict[str, Any]:
        attributes = {
            "POSITION": self.add(skin.mesh.vertices, _VERTICES, bounds=True),
            "NORMAL": self.add(skin.normals, _VERTICES),
            "JOINTS_0": self.add(skin.joints.astype(np.uint16), _VERTICES),
            "WEIGHTS_0": self.add(skin.weights, _VERTICES),
        }
        indices = self.add(skin.mesh.faces.astype(np.uint32).reshape(-1), _INDICES)
        return {"attributes": attributes, "indices": indices, "material": 0}

    def write(self, path: str | Path, document: dict[str, Any]) -> None:
        """GLB: a header and two chunks, each padded to four bytes (glTF 2.0 §4.4)."""
        first, *others = document.get("buffers") or [{}]
        document |= {
            "buffers": [first | {"byteLength": len(self.binary)}, *others],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary)))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)
