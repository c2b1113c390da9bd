"""BVH (Biovision hierarchy): any hierarchy and channel order in; Y-up with ZYX channels out.

A joint's rotation is the product of its rotation channels in the file's order (the first one outermost), acting on the
bind pose given by the OFFSETs. Position channels replace a joint's OFFSET, as Blender reads them, or shift it, as the
values show.
"""

import math
import re
import warnings
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice, pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.boundary.limits import LIMITS
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.motion_npz import even_frames
from wearcap.io.formats.smpl import A
from wearcap.recording.motion import Motion

_CHANNELS = {f"{axis}{kind}": (kind[0], axis) for axis in "xyz" for kind in ("position", "rotation")}
MAX_JOINTS = LIMITS["bvh"].items
_MAX_WORDS = 64
"""Most words of a joint's name."""
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
_LONGEST_STEP_S = 4.0
"""A longer time step is in milliseconds (at most 250 Hz): in no motion do four seconds pass between frames."""
_END_SITE = -1
"""Index that marks an End Site among the open blocks."""
UNITS_M = {
    "metres": 1.0,
    "decimetres": 0.1,
    "centimetres": 0.01,
    "millimetres": 0.001,
    "inches": 0.0254,
    "feet": 0.3048,
    "CMU's units": 0.0254 / 0.45,
}
REACH_PER_HEIGHT = 1.46
"""Longest path along the bones (fingertip to toe tip) over body height; in the tested skeletons 1.46 … 1.53."""
HEIGHT_M = (0.6, 2.6)
_LOST_DEG = 0.5
"""Largest turn about an axis without a channel that may be lost."""
_R_FILE_WORLD = A.T.contiguous()
"""wearcap's axes in those of the files that are written."""


@dataclass
class _Joint:
    """One joint of the file; offsets in file units."""

    name: str
    parent: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[tuple[str, str]] = field(default_factory=list)
    """("p" or "r", axis) in the file's order."""
    end: list[float] | None = None


class _Hierarchy:
    """The joints of a HIERARCHY, parents first, from its words; `line` is the number of the last word's line."""

    def __init__(self, lines: Iterator[tuple[int, str]]):
        self.line, self.motion_line = 1, 0
        self.joints: list[_Joint] = []
        self.open: list[int] = []
        """Joints whose blocks are open."""
        self.words = self.split(lines)

    @classmethod
    def read(cls, path: Path, lines: Iterator[tuple[int, str]]) -> tuple[list[_Joint], int]:
        """Joints with parents first, and the number of the MOTION line, up to which the lines are consumed."""
        found, line = cls(lines), 1
        try:
            for word in found.words:
                line = found.line
                found.take(word)
        except (ValueError, IndexError, StopIteration) as error:
            what = f"the hierarchy is broken here ({str(error) or 'it ends too early'})"[:200]
            raise WearcapError(what, at_line(path, line), "BVH") from error
        if not found.joints or found.open or not found.motion_line:
            what = "no complete HIERARCHY followed by MOTION"
            raise WearcapError(what, at_line(path, found.line), "a whole BVH file", "Fetch it again.")
        if len({joint.name for joint in found.joints}) < len(found.joints):
            raise WearcapError("two joints share a name", path, "unique joint names")
        return found.joints, found.motion_line

    def split(self, lines: Iterator[tuple[int, str]]) -> Iterator[str]:
        """Words until the line MOTION."""
        for number, line in lines:
            self.line = number
            if line.strip().upper() == "MOTION":
                self.motion_line = number
                return
            yield from line.replace("{", " { ").replace("}", " } ").split()

    def take(self, word: str) -> None:
        """Read what a word begins. Raises ValueError, IndexError or StopIteration where something else follows."""
        key = word.upper()
        if key in ("ROOT", "JOINT", "END"):
            self.begin(key, self.name())
        elif key == "OFFSET":
            offset = finite_floats(islice(self.words, 3)).tolist()
            if len(offset) != 3 or not self.open:
                raise ValueError("OFFSET needs three numbers inside a joint")
            if self.open[-1] != _END_SITE:
                self.joints[self.open[-1]].offset = offset
            elif self.joints[self.open[-2]].end is None:
                self.joints[self.open[-2]].end = offset
        elif key == "CHANNELS":
            count = int(next(self.words))
            if not 0 <= count <= len(_CHANNELS):
                raise ValueError(f"CHANNELS {count}")
            names = [name.lower() for name in islice(self.words, count)]
            if not self.open or self.open[-1] == _END_SITE or self.joints[self.open[-1]].channels:
                raise ValueError("CHANNELS belongs once into a joint")
            if len(names) != count or not set(names) <= set(_CHANNELS) or len(set(names)) != count:
                raise ValueError(f"CHANNELS {count} with {' '.join(names)[:80]}")
            self.joints[self.open[-1]].channels = [_CHANNELS[name] for name in names]
        elif key == "}":
            self.open.pop()
        elif key != "HIERARCHY":
            raise ValueError(f"unknown word {word[:30]!r}")

    def name(self) -> str:
        """The words until a block opens."""
        words: list[str] = []
        while (word := next(self.words)) != "{":
            if len(words) == _MAX_WORDS:
                raise ValueError("a name without an end")
            words.append(word)
        return " ".join(words)

    def begin(self, key: str, name: str) -> None:
        """Open a ROOT, JOINT or End Site block."""
        if (key == "ROOT") != (not self.open) or (key == "ROOT" and self.joints):
            raise ValueError(f"{key} {name[:30]!r} stands in the wrong place; one ROOT holds everything")
        if self.open and self.open[-1] == _END_SITE:
            raise ValueError("an End Site holds another joint")
        if key == "END":
            self.open.append(_END_SITE)
            return
        if not name or len(self.joints) >= MAX_JOINTS:
            raise ValueError("a joint without a name" if not name else f"more than {MAX_JOINTS} joints")
        self.joints.append(_Joint(name, self.open[-1] if self.open else -1))
        self.open.append(len(self.joints) - 1)


def _plain(lines: Iterator[tuple[int, str]], mended: Counter[str]) -> Iterator[tuple[int, str]]:
    """Lines without comments, and with points for decimal commas; `mended` counts both, by the note that says so."""
    for number, line in lines:
        if line.lstrip().startswith(("#", "//")):
            mended["Lines that are comments: {}."] += 1
        elif "." not in line and (pointed := _DECIMAL_COMMA.sub(".", line)) != line:
            mended["Lines whose decimal commas are read as points: {}."] += 1
            yield number, pointed
        elif line.strip():
            yield number, line


def _parse_motion(
    path: Path, lines: Iterator[tuple[int, str]], motion_line: int, channels: int
) -> tuple[float, np.ndarray, list[str]]:
    """Time step (s), values "time channel", and what was mended: the rows say how many frames there are."""
    try:
        (_, first), (line, second) = next(lines), next(lines)
        count = int(first.lower().split("frames:")[1])
        step = float(second.lower().split("frame time:")[1])
    except (ValueError, IndexError, StopIteration) as error:
        raise WearcapError("no 'Frames:' and 'Frame Time:' below MOTION", at_line(path, motion_line)) from error
    values, odd, notes = array("d"), None, []
    for (number, text), (following, _) in pairwise(chain(lines, [(0, "")])):
        words, where = text.split(), at_line(path, number)
        cut = len(words) < channels or (len(values) < (count - 1) * channels and not text.endswith("\n"))
        if cut and not following and values and odd is None:
            fix = "Fetch it again; or delete its last row to read the others."
            raise WearcapError(f"cut short: {len(words)} of {channels} values", where, "a whole last row", fix)
        values.extend(finite_floats(words, where))
        if len(words) != channels and odd is None:
            odd = WearcapError(f"{len(words)} values", where, f"{channels}, one per channel of the hierarchy")
    if odd is not None and len(values) != count * channels:
        raise odd
    if not values:
        fix = "It holds a skeleton alone: export it again with its motion."
        raise WearcapError("no frames", path, "a row of numbers for each frame, below 'Frame Time:'", fix)
    table = np.asarray(values).reshape(-1, channels)
    if len(table) != count:
        notes.append(f"Its header says {count} frames, its rows are {len(table)}: the rows are believed.")
    step_s, note = _seconds(step, at_line(path, line))
    return step_s, table, notes + note


def _seconds(step: float, where: str) -> tuple[float, list[str]]:
    """A time step in seconds, and the note on one that can only be milliseconds.

    Raises WearcapError for a step that is none, and for one that may as well be a frame rate.
    """
    if not 1e-5 <= step <= 1000:
        raise WearcapError(f"frame time {step} s", where, "seconds per frame, above 0")
    if step <= _LONGEST_STEP_S:
        return step, []
    # Usual rates are multiples of 5 or 12, or those of television, slower by 1001/1000.
    near = [round(rate) for rate in (step, 1.001 * step) if abs(rate - round(rate)) < 0.005]
    if any(rate % 5 == 0 or rate % 12 == 0 for rate in near):
        fix = f"Write 'Frame Time: {step / 1000:.6g}' for {step:g} ms, or 'Frame Time: {1 / step:.6g}' for {step:g} Hz."
        raise WearcapError(
            f"a frame time of {step:g}, which is milliseconds or a rate", where, "seconds per frame", fix
        )
    return step / 1000, [f"Its frame time, {step:g}, is read as milliseconds: {1000 / step:.4g} Hz."]


@dataclass(frozen=True)
class BvhContent:
    """What a BVH file says, in its own axes and units."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    t_rest: Float[Tensor, "joint 3"]
    """OFFSETs: places in the parent's frame in the bind pose."""
    ends: tuple[tuple[float, float, float] | None, ...]
    """End Sites."""
    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_parent_joint: Float[Tensor, "time joint 3"]
    """Places in the parent's frame (the root's in the world), of position channels where a joint has them."""
    step_s: float
    notes: tuple[str, ...] = ()
    """What was mended in it, in sentences."""
    hierarchy: tuple[str, ...] = ()
    """The lines above its numbers, up to MOTION."""
    channels: tuple[tuple[tuple[str, str], ...], ...] = ()
    """Of each joint: ("p" or "r", axis) in the file's order."""
    shifted: tuple[int, ...] = ()
    """Joints whose position channels are shifts from their OFFSETs."""


def read_bvh_content(path: str | Path) -> BvhContent:
    """Read a .bvh file (plain, .gz or .xz) as it stands. Raises WearcapError naming file and line."""
    path = Path(path)
    mended: Counter[str] = Counter()
    lines, hierarchy = _plain(numbered_lines(path), mended), list[str]()

    def kept() -> Iterator[tuple[int, str]]:
        for number, line in lines:
            hierarchy.append(line.rstrip())
            yield number, line

    joints, motion_line = _Hierarchy.read(path, kept())
    step_s, values, notes = _parse_motion(path, lines, motion_line, sum(len(joint.channels) for joint in joints))
    t, R, shifts = _channels(joints, values)
    notes += [note.format(count) for note, count in mended.items()]
    if shifts:
        notes.append(f"Position channels of {len(shifts)} joints are read as shifts from their OFFSETs.")
    ends = ((None if joint.end is None else (joint.end[0], joint.end[1], joint.end[2])) for joint in joints)
    return BvhContent(
        tuple(joint.name for joint in joints),
        tuple(joint.parent for joint in joints),
        torch.tensor([joint.offset for joint in joints], dtype=torch.float64),
        tuple(ends),
        R,
        t,
        step_s,
        tuple(notes),
        tuple(hierarchy),
        tuple(tuple(joint.channels) for joint in joints),
        tuple(shifts),
    )


def axes_rotation(path: Path, up: str, forward: str) -> Tensor:
    """R_world_file from the names of the axes that point up and forward."""
    rows = {}
    for name in (up, forward):
        if name.removeprefix("-") not in ("x", "y", "z"):
            raise WearcapError(f"axis {name!r}", path, 'one of "x", "y", "z", "-x", "-y", "-z"')
        row = torch.zeros(3, dtype=torch.float64)
        row["xyz".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
        rows[name] = row
    if up[-1] == forward[-1]:
        what = f"up {up!r} and forward {forward!r} are one axis"
        raise WearcapError(what, path, fix='For a z-up file give forward as well, mostly "-y", "x" or "y".')
    return torch.stack([rows[forward], torch.linalg.cross(rows[up], rows[forward]), rows[up]])


def _channels(
    joints: list[_Joint], values: np.ndarray
) -> tuple[Float[Tensor, "time joint 3"], Float[Tensor, "time joint 3 3"], list[int]]:
    """Places in the parents' frames (file units), rotations, and the joints whose positions are shifts.

    Some writers give children shifts from OFFSET, near zero, instead of the whole offset: they are added to it.
    """
    columns = torch.from_numpy(values)
    starts = np.cumsum([0, *(len(joint.channels) for joint in joints)]).tolist()
    t = torch.tensor([joint.offset for joint in joints], dtype=torch.float64).repeat(len(values), 1, 1)
    by_order: dict[str, list[int]] = {}
    moved = set()
    for k, joint in enumerate(joints):
        for column, (kind, axis) in enumerate(joint.channels, starts[k]):
            if kind == "p":
                t[:, k, "xyz".index(axis)] = columns[:, column]
                moved.add(k)
        by_order.setdefault("".join(axis for kind, axis in joint.channels if kind == "r"), []).append(k)
    children = sorted(moved - {0})
    rest = t.new_tensor([joints[k].offset for k in children]).reshape(-1, 3)
    shifted = _are_shifts(t[:, children], rest)
    t[:, children] += rest * shifted[:, None]
    R = torch.eye(3, dtype=torch.float64).repeat(len(values), len(joints), 1, 1)
    for order, members in by_order.items():
        for axis in order:
            index = [starts[k] + joints[k].channels.index(("r", axis)) for k in members]
            R[:, members] = R[:, members] @ about_axis(axis, columns[:, index] * (math.pi / 180))
    return t, R, [joint for joint, shift in zip(children, shifted.tolist()) if shift]


def _are_shifts(values: Float[Tensor, "time joint 3"], rest: Float[Tensor, "joint 3"]) -> Bool[Tensor, "joint"]:
    """Whether joints' position channels are shifts, near zero, from their OFFSETs `rest` rather than near these.

    Each axis on which one is clearly nearer votes. A joint whose axes disagree, as of hips far from their OFFSET, or do
    not vote, follows the others.
    """
    median = values.median(0).values
    room = (values - median).abs().mean(0) + 0.02 * rest.abs() + 1e-9
    for_shift = (((median - rest).abs() + room) / (median.abs() + room)).log()
    votes = (for_shift > 1).any(-1).int() - (for_shift < -1).any(-1).int()
    return torch.where(votes == 0, votes.sum(), votes) > 0


def longest_path(skeleton: Skeleton) -> float:
    """Length (m) of the longest path along the bones from one end of the tree to another."""
    bones = skeleton.t_parent_joint.double().norm(dim=-1).tolist()
    down = [0.0] * len(skeleton)
    for site in skeleton.sites.values():
        joint = skeleton.index(site.joint)
        down[joint] = max(down[joint], torch.tensor(site.t_joint_site).norm().item())
    longest = 0.0
    for joint in range(len(skeleton) - 1, 0, -1):
        parent, length = skeleton.parents[joint], down[joint] + bones[joint]
        longest = max(longest, down[parent] + length)
        down[parent] = max(down[parent], length)
    return longest


def write_bvh(
    motion: Motion, path: str | Path, unit_m: float | int = 0.01, origin: Float[Tensor, "3"] | None = None
) -> None:
    """Write a motion as BVH: y up, body facing +z at rest, ZYX channels in degrees, by default in centimetres.

    The farthest site of each leaf joint becomes its End Site. A gap in time is filled with the nearest frame, for BVH
    has one frame rate; `origin` (m) is added to all places. Raises WearcapError when there is nothing to write or it is not finite.
    """
    frames, fps = even_frames(motion)
    R = _R_FILE_WORLD @ motion.R_parent_joint[frames].double() @ _R_FILE_WORLD.T
    placed = motion.t_world_root[frames].double() + (0.0 if origin is None else origin)
    root = placed @ _R_FILE_WORLD.T / unit_m
    if not (R.isfinite().all() and root.isfinite().all()):
        raise WearcapError("the motion holds NaN or infinite values", path, "finite poses")
    # R = Rz · Ry · Rx; at gimbal lock x is zero.
    cos_y = torch.hypot(R[..., 0, 0], R[..., 1, 0])
    locked = cos_y < 1e-7
    x = torch.where(locked, 0.0, torch.atan2(R[..., 2, 1], R[..., 2, 2]))
    z = torch.where(locked, torch.atan2(-R[..., 0, 1], R[..., 1, 1]), torch.atan2(R[..., 1, 0], R[..., 0, 0]))
    zyx = torch.stack([z, torch.atan2(-R[..., 2, 0], cos_y), x], -1)
    degrees = np.unwrap(np.degrees(zyx.numpy()), axis=0, period=360)
    order: list[int] = []
    lines = ["HIERARCHY", *_hierarchy(motion.skeleton, 0, 0, float(unit_m), order)]
    table = np.concatenate([root.numpy(), degrees[:, order].reshape(len(frames), -1)], -1)
    row = " ".join(["%.6f"] * table.shape[1])
    lines += ["MOTION", f"Frames: {len(table)}", f"Frame Time: {1 / fps:.9f}"]
    lines += [row % tuple(values) for values in table.tolist()]
    write_text(path, "\n".join(lines) + "\n")


def write_bvh_like(
    like: BvhContent,
    path: str | Path,
    R_parent_joint: Float[Tensor, "time joint 3 3"],
    t_parent_joint: Float[Tensor, "time joint 3"],
    fps: float,
) -> None:
    """Write frames below the hierarchy of another file, in its unit, axes and order of channels.

    Raises WearcapError for numbers that are not finite, and where a joint turns about an axis that it has no channel for.
    """
    if not (R_parent_joint.isfinite().all() and t_parent_joint.isfinite().all()):
        raise WearcapError("the motion holds NaN or infinite values", path, "finite poses")
    columns: list[np.ndarray] = []
    for joint, channels in enumerate(like.channels):
        axes = [axis for kind, axis in channels if kind == "r"]
        order = "".join([*axes, *(axis for axis in "xyz" if axis not in axes)]).upper()
        with warnings.catch_warnings():  # at gimbal lock the third angle is 0, and the rotation the same
            warnings.simplefilter("ignore", UserWarning)
            angles = Rotation.from_matrix(R_parent_joint[:, joint].double().numpy()).as_euler(order, degrees=True)
        if np.abs(angles[:, len(axes) :]).max(initial=0.0) > _LOST_DEG:
            what = (
                f"joint {like.names[joint]!r} turns about more axes than it has channels ({' '.join(axes) or 'none'})"
            )
            raise WearcapError(what, path, "a rotation channel for each axis")
        turned = dict(zip(axes, np.unwrap(angles, axis=0, period=360).T))
        place = t_parent_joint[:, joint].double() - like.t_rest[joint] * (joint in like.shifted)
        columns += [turned[axis] if kind == "r" else place[:, "xyz".index(axis)].numpy() for kind, axis in channels]
    row = " ".join(["%.6f"] * len(columns))
    lines = [*like.hierarchy, f"Frames: {len(R_parent_joint)}", f"Frame Time: {1 / fps:.9f}"]
    lines += [row % tuple(values) for values in np.stack(columns, -1).tolist()]
    write_text(path, "\n".join(lines) + "\n")


def _hierarchy(skeleton: Skeleton, joint: int, depth: int, unit_m: float, order: list[int]) -> list[str]:
    """The lines of one joint's block; its joints are appended to `order` as they are named."""
    order.append(joint)
    tab = "\t" * depth
    offset = _R_FILE_WORLD @ skeleton.t_parent_joint[joint].double() / unit_m * (joint > 0)
    position = "6 Xposition Yposition Zposition" if joint == 0 else "3"
    lines = [
        f"{tab}{'JOINT' if joint else 'ROOT'} {skeleton.joint_names[joint]}",
        tab + "{",
        tab + "\tOFFSET {:.6f} {:.6f} {:.6f}".format(*offset.tolist()),
        f"{tab}\tCHANNELS {position} Zrotation Yrotation Xrotation",
    ]
    children = [child for child, parent in enumerate(skeleton.parents) if parent == joint]
    for child in children:
        lines += _hierarchy(skeleton, child, depth + 1, unit_m, order)
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
