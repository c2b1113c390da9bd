"""BVH (Biovision hierarchy): any hierarchy and channel order in; Y-up with ZYX channels out.

A joint's rotation is the product of its rotation channels in the file's order (the first one outermost), acting on the
bind pose given by the OFFSETs. Position channels replace a joint's OFFSET, as Blender reads them.
"""

import math
import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Site, Skeleton
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.bvh_check import check_body
from wearcap.io.formats.bvh_parse import BvhJoint, parse_hierarchy, parse_motion
from wearcap.io.formats.frame_grid import even_frames, nominal_fps
from wearcap.io.formats.text import numbered_lines
from wearcap.recording.motion import Motion

END_SITES = {
    "toe": "toe_tip",
    "toebase": "toe_tip",
    "wrist": "fingertip",
    "handindex1": "fingertip",
    "thumb": "thumb_tip",
}
"""wearcap's names of End Sites, by the joint's name without its side."""

STRETCH_M = 0.005
"""Largest change of a bone's length without a warning."""

CGSPEED_UNIT_M = 0.0254 / 0.45
CGSPEED_THORAX = (0.0, 2.07, 0.0)
"""Offset (file units) that cgspeed's BVH conversion of the CMU database dropped between thorax and neck or shoulders."""


def read_bvh(
    path: str | Path,
    *,
    unit_m: float | int = 0.01,
    up: str = "y",
    forward: str = "z",
    check: bool = True,
    offsets: dict[str, tuple[float, float, float]] | None = None,
) -> Motion:
    """Read a .bvh file (plain, .gz or .xz). Rest is the file's bind pose; End Sites become sites.

    `unit_m`: metres per unit. `up`, `forward`: the file's axes ("x", "-y" …) that point up, and ahead of the body in
    its bind pose. `offsets` (file units) replaces OFFSETs that are known to be wrong. Raises WearcapError naming file
    and line, and, unless `check` is False, when the body is no person's size or lies down, with the setting that fixes it.
    """
    path = Path(path)
    R_world_file = _axes(path, up, forward)
    lines = numbered_lines(path)
    joints, motion_line = parse_hierarchy(path, lines)
    step_s, values = parse_motion(path, lines, motion_line, sum(len(joint.channels) for joint in joints))
    for joint in joints:
        joint.offset = list((offsets or {}).get(joint.name, joint.offset))
    translation, R = _channels(joints, values)
    bones = _bones(path, joints, translation, float(unit_m))
    to_world = float(unit_m) * R_world_file.T
    skeleton = Skeleton(
        "bvh",
        tuple(joint.name for joint in joints),
        tuple(joint.parent for joint in joints),
        (bones @ to_world).float(),
        _sites(joints, to_world),
    )
    root = (
        translation[0]
        if translation[0] is not None
        else torch.tensor(joints[0].offset, dtype=torch.float64).expand(len(values), 3)
    )
    motion = Motion(
        torch.arange(len(values), dtype=torch.float64) / nominal_fps(1 / step_s),
        skeleton,
        (R_world_file @ R @ R_world_file.T).float(),
        (root @ to_world).float(),
        provenance={"source": path.name, "format": "bvh"},
    )
    if check:
        check_body(motion, path, float(unit_m), R_world_file)
    return motion


def read_cmu_bvh(path: str | Path) -> Motion:
    """Read one of cgspeed's BVH conversions of the CMU database: its unit, its lost thorax bone, its T-pose frame.

    Raises WearcapError as `read_bvh` does.
    """
    lost = ("Neck", "LeftShoulder", "RightShoulder")
    motion = read_bvh(path, unit_m=CGSPEED_UNIT_M, offsets=dict.fromkeys(lost, CGSPEED_THORAX))
    if len(motion) < 2:
        raise WearcapError("only the T-pose frame", where=path, expected="frames of motion after it")
    motion = motion.sliced(1, len(motion))
    return Motion(
        motion.timestamps - motion.timestamps[0],
        motion.skeleton,
        motion.R_parent_joint,
        motion.t_world_root,
        provenance=motion.provenance,
    )


def _axes(path: Path, up: str, forward: str) -> Tensor:
    """R_world_file from the names of the axes that point up and forward."""
    rows = {}
    for name in (up, forward):
        if name.removeprefix("-") not in ("x", "y", "z"):
            raise WearcapError(f"axis {name!r}", where=path, expected='one of "x", "y", "z", "-x", "-y", "-z"')
        row = torch.zeros(3, dtype=torch.float64)
        row["xyz".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
        rows[name] = row
    if up[-1] == forward[-1]:
        raise WearcapError(
            f"up {up!r} and forward {forward!r} are one axis",
            where=path,
            fix='For a z-up file give forward as well, mostly "-y", "x" or "y".',
        )
    return torch.stack([rows[forward], torch.linalg.cross(rows[up], rows[forward]), rows[up]])


# --- reading ---------------------------------------------------------------------------------------------------


def _channels(
    joints: list[BvhJoint], values: np.ndarray
) -> tuple[list[Tensor | None], Float[Tensor, "time joint 3 3"]]:
    """Per joint its translations "time 3" (file units; None without position channels), and all rotations."""
    columns = torch.from_numpy(values)
    starts = np.cumsum([0, *(len(joint.channels) for joint in joints)]).tolist()
    translation: list[Tensor | None] = []
    by_order: dict[str, list[int]] = {}
    for k, joint in enumerate(joints):
        moved = torch.tensor(joint.offset, dtype=torch.float64).repeat(len(values), 1)
        for column, (kind, axis) in enumerate(joint.channels, starts[k]):
            if kind == "p":
                moved[:, "xyz".index(axis)] = columns[:, column]
        translation.append(moved if any(kind == "p" for kind, _ in joint.channels) else None)
        by_order.setdefault("".join(axis for kind, axis in joint.channels if kind == "r"), []).append(k)
    R = torch.eye(3, dtype=torch.float64).repeat(len(values), len(joints), 1, 1)
    for order, members in by_order.items():
        for axis in order:
            index = [starts[k] + joints[k].channels.index(("r", axis)) for k in members]
            R[:, members] = R[:, members] @ about_axis(axis, columns[:, index] * (math.pi / 180))
    return translation, R


def _bones(
    path: Path, joints: list[BvhJoint], translation: list[Tensor | None], unit_m: float
) -> Float[Tensor, "joint 3"]:
    """Constant bone offsets (file units; the root's is zero), from OFFSET or from the position channels' median."""
    bones = torch.tensor([joint.offset for joint in joints], dtype=torch.float64)
    moved = {k: t for k, t in enumerate(translation) if t is not None and k > 0}
    if moved:
        median = {k: t.median(0).values for k, t in moved.items()}
        # Some writers give children displacements from OFFSET, near zero, instead of the whole offset.
        whole = sum((median[k] - bones[k]).norm() for k in moved) <= sum(median[k].norm() for k in moved)
        stretch = {k: (t - median[k]).norm(dim=-1).max().item() * unit_m for k, t in moved.items()}
        worst = max(stretch, key=lambda k: stretch[k])
        if stretch[worst] > STRETCH_M:
            warnings.warn(
                f"{path}: bone {joints[worst].name!r} changes its length by up to {stretch[worst]:.3f} m; "
                "its median is kept",
                stacklevel=3,
            )
        for k in moved:
            bones[k] = median[k] if whole else bones[k] + median[k]
    bones[0] = 0
    return bones


def _sites(joints: list[BvhJoint], to_world: Float[Tensor, "3 3"]) -> dict[str, Site]:
    sites = {}
    for joint in joints:
        if joint.end is not None:
            end = torch.tensor(joint.end, dtype=torch.float64) @ to_world
            sites[_site_name(joint.name)] = Site(joint.name, tuple(end.tolist()))
    return sites


def _site_name(joint: str) -> str:
    plain = joint.lower().replace("_", "")
    if plain == "head":
        return "crown"
    for side, start in (("left", "left"), ("right", "right"), ("left", "l"), ("right", "r")):
        if plain.startswith(start) and plain.removeprefix(start) in END_SITES:
            return f"{side}_{END_SITES[plain.removeprefix(start)]}"
    return f"{joint}_end"


# --- writing ---------------------------------------------------------------------------------------------------

_R_FILE_WORLD = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)


def write_bvh(motion: Motion, path: str | Path, unit_m: float | int = 0.01) -> None:
    """Write a motion as BVH: y up, body facing +z at rest, ZYX channels in degrees, by default in centimetres.

    The farthest site of each leaf joint becomes its End Site. A gap in time is filled with the nearest frame, for BVH
    has one frame rate. Raises WearcapError when there is nothing to write or it is not finite.
    """
    frames, fps = even_frames(motion)
    R = _R_FILE_WORLD @ motion.R_parent_joint[frames].double() @ _R_FILE_WORLD.T
    root = motion.t_world_root[frames].double() @ _R_FILE_WORLD.T / unit_m
    if not (R.isfinite().all() and root.isfinite().all()):
        raise WearcapError("the motion holds NaN or infinite values", where=path, expected="finite poses")
    degrees = np.unwrap(np.degrees(_zyx(R).numpy()), axis=0, period=360)
    order = _depth_first(motion.skeleton)
    table = np.concatenate([root.numpy(), degrees[:, order].reshape(len(frames), -1)], -1)
    row = " ".join(["%.6f"] * table.shape[1])
    lines = [
        "HIERARCHY",
        *_hierarchy(motion.skeleton, 0, 0, float(unit_m)),
        "MOTION",
        f"Frames: {len(table)}",
        f"Frame Time: {1 / fps:.9f}",
        *(row % tuple(values) for values in table.tolist()),
    ]
    write_text(path, "\n".join(lines) + "\n")


def _zyx(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Angles (z, y, x) in rad with R = Rz · Ry · Rx; at gimbal lock x is zero."""
    cos_y = torch.hypot(R[..., 0, 0], R[..., 1, 0])
    locked = cos_y < 1e-7
    x = torch.where(locked, 0.0, torch.atan2(R[..., 2, 1], R[..., 2, 2]))
    z = torch.where(locked, torch.atan2(-R[..., 0, 1], R[..., 1, 1]), torch.atan2(R[..., 1, 0], R[..., 0, 0]))
    return torch.stack([z, torch.atan2(-R[..., 2, 0], cos_y), x], -1)


def _children(skeleton: Skeleton, joint: int) -> list[int]:
    return [child for child, parent in enumerate(skeleton.parents) if parent == joint]


def _depth_first(skeleton: Skeleton, joint: int = 0) -> list[int]:
    """Joints in the order in which a BVH hierarchy names them."""
    return [joint, *(k for child in _children(skeleton, joint) for k in _depth_first(skeleton, child))]


def _hierarchy(skeleton: Skeleton, joint: int, depth: int, unit_m: float) -> list[str]:
    """The lines of one joint's block."""
    tab = "\t" * depth
    offset = _R_FILE_WORLD @ skeleton.t_parent_joint[joint].double() / unit_m * (joint > 0)
    position = "6 Xposition Yposition Zposition" if joint == 0 else "3"
    lines = [
        f"{tab}{'JOINT' if joint else 'ROOT'} {skeleton.joint_names[joint]}",
        tab + "{",
        tab + "\tOFFSET {:.6f} {:.6f} {:.6f}".format(*offset.tolist()),
        f"{tab}\tCHANNELS {position} Zrotation Yrotation Xrotation",
    ]
    children = _children(skeleton, joint)
    for child in children:
        lines += _hierarchy(skeleton, child, depth + 1, unit_m)
    if not children:
        ends = [site.t_joint_site for site in skeleton.sites.values() if site.joint == skeleton.joint_names[joint]]
        end = max(ends, key=lambda end: math.hypot(*end), default=(0.0, 0.0, 0.0))
        end = _R_FILE_WORLD @ torch.tensor(end, dtype=torch.float64) / unit_m
        lines += [
            f"{tab}\tEnd Site",
            tab + "\t{",
            tab + "\t\tOFFSET {:.6f} {:.6f} {:.6f}".format(*end.tolist()),
            tab + "\t}",
        ]
    return [*lines, tab + "}"]
