"""Acclaim ASF (skeleton) and AMC (motion), the format of the CMU and HDM05 motion capture databases.

A bone's rotation is L = C · R(dof) · C⁻¹ with C the bone's own axes in the bind pose; G = G_parent · L; a bone ends at
its parent's end + G · direction · length. Files are y up with the body facing +z at rest, in degrees and inches over
the file's length scale (CMU: 1 unit = 0.0254 / 0.45 m). Their axes are SMPL's, which `A` turns to wearcap's.
"""

import math
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import Site, Skeleton
from wearcap.boundary.limits import LIMITS
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.smpl import A
from wearcap.recording.motion import Motion

INCH_M = 0.0254
MAX_BONES = LIMITS["asf"].items
ROTATIONS = ("rx", "ry", "rz")
SIDES = {"l": "left", "r": "right"}
END_SITES = {"toes": "toe_tip", "fingers": "fingertip", "thumb": "thumb_tip"}
_CMU_SPINE = "root lowerback upperback thorax lowerneck upperneck head"
_CMU_LIMBS = "hipjoint femur tibia foot toes clavicle humerus radius wrist hand fingers thumb"
"""Names of CMU's nodes; those of the limbs follow "l" or "r"."""
HEEL_BACK, HEEL_DOWN = 0.35, 0.45
"""Heel behind and below the ankle joint, as fractions of the foot bone (the file has no heel)."""


@dataclass
class _Bone:
    name: str
    line: int
    direction: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    length: float = 0.0
    axis_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    order: str = "xyz"
    dof: tuple[str, ...] = ()


@dataclass(frozen=True)
class _AsfSkeleton:
    """Content of an ASF file that reading an AMC file needs; per joint in the order of `skeleton.joint_names`."""

    skeleton: Skeleton
    dof: tuple[tuple[str, ...], ...]
    """Channels of each joint as the AMC lists them ("tx" … "rz")."""
    order: tuple[str, ...]
    """Order in which a joint's rotations act on the bone: "xyz" means Rz · Ry · Rx."""
    R_bind_axis: Float64[Tensor, "joint 3 3"]
    """C of the module's formula: each joint's own axes in the bind pose, in the file's axes."""
    t_root: Float64[Tensor, "3"]
    """Position of the root when its channels are zero, in the file's axes (m)."""
    unit_m: float
    radians: bool


def read_asf(path: str | Path) -> _AsfSkeleton:
    """Read an .asf file (plain, .gz or .xz).

    The skeleton is called "cmu31" when its nodes are CMU's, else by the file's name; each joint is a node's START, rest
    is the bind pose, and the ends of leaf bones are sites. Raises WearcapError naming file and line.
    """
    path = Path(path)
    content = _AsfContent.read(path)
    cmu_nodes = {*_CMU_SPINE.split(), *(side + part for side in SIDES for part in _CMU_LIMBS.split())}
    unit_m = INCH_M / content.length
    names, parents = content.tree_order(path)
    table = [content.root, *(content.bones[name] for name in names[1:])]
    ends = torch.tensor([bone.direction for bone in table], dtype=torch.float64)
    lengths = torch.tensor([bone.length for bone in table], dtype=torch.float64)
    ends = ends * lengths[:, None] * unit_m @ A.T
    offsets = ends[[max(parent, 0) for parent in parents]]
    offsets[0] = 0
    leaves = {name: ends[joint] for joint, name in enumerate(names) if joint not in parents}
    skeleton = Skeleton(
        "cmu31" if set(names) == cmu_nodes else path.name.split(".")[0],
        tuple(names),
        tuple(parents),
        offsets.float(),
        _sites(names, ends, leaves),
    )
    to_rad = 1.0 if content.radians else math.pi / 180
    angles = to_rad * torch.tensor([bone.axis_deg for bone in table], dtype=torch.float64)
    order = tuple(bone.order for bone in table)
    return _AsfSkeleton(
        skeleton,
        tuple(bone.dof for bone in table),
        order,
        _euler(angles, order),
        unit_m * torch.tensor(content.root.direction, dtype=torch.float64),
        unit_m,
        content.radians,
    )


def read_amc(asf: _AsfSkeleton, path: str | Path, fps: float | int = 120) -> Motion:
    """Read an .amc file (plain, .gz or .xz) of this skeleton; the format carries no frame rate, CMU's is 120.

    Timestamps start at 0 and follow the file's frame numbers, so that dropped frames show as gaps.
    Raises WearcapError naming file and line.
    """
    path = Path(path)
    if not (math.isfinite(fps) and fps > 0):
        raise WearcapError(f"frame rate {fps}", path, "a positive number of frames per second")
    frames, joints, values = _parse_amc(path, asf)
    channels = [(joint, dof) for joint in joints for dof in asf.dof[joint]]
    angles = torch.zeros(len(values), len(asf.skeleton), 3, dtype=torch.float64)
    t_root = asf.t_root.expand(len(values), 3).clone()
    for column, (joint, dof) in enumerate(channels):
        axis = "xyz".index(dof[1])
        if dof[0] == "r":
            angles[:, joint, axis] = values[:, column]
        else:
            t_root[:, axis] += asf.unit_m * values[:, column]
    R = _euler(angles if asf.radians else angles * (math.pi / 180), asf.order)
    C = asf.R_bind_axis
    # The root's own axes are its starting orientation: they turn the body and are not undone.
    undo = torch.cat([torch.eye(3, dtype=torch.float64)[None], C[1:].transpose(-1, -2)])
    R = (A @ C) @ R @ (undo @ A.T)
    return Motion(
        torch.from_numpy((frames - frames[0]) / fps),
        asf.skeleton,
        R.float(),
        (t_root @ A.T).float(),
        provenance={"source": path.name, "format": "amc"},
    )


def _euler(angles: Float[Tensor, "*batch joint 3"], order: tuple[str, ...]) -> Float[Tensor, "*batch joint 3 3"]:
    """Product of the rotations about x, y, z (rad), the first axis of each joint's `order` acting first."""
    R = torch.empty(*angles.shape, 3, dtype=angles.dtype)
    for axes in set(order):
        joints = [joint for joint, own in enumerate(order) if own == axes]
        first, second, third = (about_axis(axis, angles[..., joints, "xyz".index(axis)]) for axis in axes)
        R[..., joints, :, :] = third @ second @ first
    return R


class _AsfContent:
    """Sections of an ASF file; `take` reads one line's words and raises ValueError or IndexError for what it cannot."""

    def __init__(self) -> None:
        self.length, self.radians = 1.0, False
        self.root = _Bone("root", 1)
        self.bones: dict[str, _Bone] = {}
        self.hierarchy: list[tuple[int, list[str]]] = []
        """Lines with their words: a parent, and those below it."""
        self.section, self.bone = "", None

    @classmethod
    def read(cls, path: Path) -> "_AsfContent":
        content, number = cls(), 0
        for number, text in numbered_lines(path):
            words = text.split("#")[0].split()
            with understood(f"cannot read {text.strip()[:80]!r}", at_line(path, number), "Acclaim ASF"):
                if words:
                    content.take(number, words)
        if content.bone is not None or not content.bones or not content.hierarchy:
            what = "bones or hierarchy are missing or cut short"
            expected = "an ASF file with :bonedata and :hierarchy"
            raise WearcapError(what, at_line(path, number), expected, "Fetch the file again.")
        return content

    def tree_order(self, path: Path) -> tuple[list[str], list[int]]:
        """Names with parents before children (depth first, as the file lists them), and each one's parent."""
        children: dict[str, list[str]] = {}
        seen = {"root"}
        for line, (parent, *below) in self.hierarchy:
            for name in below:
                if name not in self.bones or name in seen:
                    expected = "every bone of :bonedata once below a parent"
                    raise WearcapError(f"bone {name!r} is unknown or has two parents", at_line(path, line), expected)
                seen.add(name)
            children.setdefault(parent, []).extend(below)
        names, parents = ["root"], [-1]
        stack = [(name, 0) for name in reversed(children.get("root", []))]
        while stack:
            name, parent = stack.pop()
            names.append(name)
            parents.append(parent)
            stack += [(child, len(names) - 1) for child in reversed(children.get(name, []))]
        if missing := sorted(set(self.bones) - set(names)):
            what = f"bones {missing[:5]} do not hang on the root"
            raise WearcapError(what, path, "one tree below 'root' in :hierarchy")
        return names, parents

    def take(self, number: int, words: list[str]) -> None:
        if words[0].startswith(":"):
            self.section, self.bone = words[0].lower(), None
        elif self.section == ":units" and words[0] == "length":
            self.length = float(finite_floats(words[1:2])[0])
            if not self.length > 0:
                raise ValueError("the length unit must be positive")
        elif self.section == ":units" and words[0] == "angle":
            self.radians = words[1].lower().startswith("rad")
        elif self.section == ":bonedata" and words[0] == "begin":
            self.bone = _Bone("", number)
        elif self.section == ":bonedata" and words[0] == "end" and self.bone is not None:
            bone = self.bone
            if not bone.name or bone.name == "root" or bone.name in self.bones:
                raise ValueError(f"the bone begun in line {bone.line} has no name of its own")
            if len(self.bones) >= MAX_BONES:
                raise ValueError(f"more than {MAX_BONES} bones")
            self.bones[bone.name], self.bone = bone, None
        elif self.section == ":root" or (self.section == ":bonedata" and self.bone is not None):
            for name, read in _FIELDS[self.section].get(words[0], {}).items():
                setattr(self.bone or self.root, name, read(words[1:]))
        elif self.section == ":hierarchy" and words[0] not in ("begin", "end"):
            self.hierarchy.append((number, words))
            if max(len(self.hierarchy), len(words)) > MAX_BONES:
                raise ValueError(f"more than {MAX_BONES} bones")


def _three(words: list[str]) -> list[float]:
    values = finite_floats(words[:3])
    if len(values) != 3:
        raise ValueError("three numbers are needed")
    return values.tolist()


def _order(word: str) -> str:
    if sorted(word.lower()) != ["x", "y", "z"]:
        raise ValueError(f"axis order {word!r} is not a permutation of XYZ")
    return word.lower()


def _channels(words: list[str], known: tuple[str, ...]) -> tuple[str, ...]:
    channels = tuple(word.lower() for word in words)
    if len(set(channels)) != len(channels) or not set(channels) <= set(known):
        raise ValueError(f"channels must be different ones of {' '.join(known)}")
    return channels


_FIELDS: dict[str, dict[str, dict[str, Callable[[list[str]], Any]]]] = {
    ":root": {
        "order": {"dof": lambda words: _channels(words, ("tx", "ty", "tz", *ROTATIONS))},
        "axis": {"order": lambda words: _order(words[0])},
        "position": {"direction": _three},
        "orientation": {"axis_deg": _three},
    },
    ":bonedata": {
        "name": {"name": lambda words: words[0]},
        "direction": {"direction": _three},
        "length": {"length": lambda words: float(finite_floats(words[:1])[0])},
        "axis": {"axis_deg": _three, "order": lambda words: _order(words[3])},
        "dof": {"dof": lambda words: _channels(words, ROTATIONS)},
    },
}
"""By section and a line's first word: the fields of `_Bone` that it sets, and how its other words are read."""


def _sites(names: list[str], ends: Tensor, leaves: dict[str, Tensor]) -> dict[str, Site]:
    """Ends of the leaf bones, and for CMU's bone names the heels and palms."""
    sites = {}
    for name, end in leaves.items():
        known = END_SITES.get(name[1:]) if name[0] in SIDES else None
        site = f"{SIDES[name[0]]}_{known}" if known else "crown" if name == "head" else f"{name}_end"
        sites[site] = Site(name, tuple(end.tolist()))
    for letter, side in SIDES.items():
        if {letter + "foot", letter + "tibia"} <= set(names):
            foot, shin = (ends[names.index(letter + part)] for part in ("foot", "tibia"))
            # "Down" runs on along the shin, for bind poses stand astride.
            down = shin / shin.norm().clamp(min=1e-9)
            forward = foot - (foot @ down) * down
            forward = forward / forward.norm().clamp(min=1e-9)
            heel = foot.norm() * (HEEL_DOWN * down - HEEL_BACK * forward)
            sites[f"{side}_heel"] = Site(letter + "foot", tuple(heel.tolist()))
        if letter + "hand" in names:
            sites[f"{side}_palm"] = Site(letter + "hand", tuple(ends[names.index(letter + "hand")].tolist()))
    return sites


def _parse_amc(path: Path, asf: _AsfSkeleton) -> tuple[np.ndarray, list[int], Float64[Tensor, "time channel"]]:
    """Frame numbers, joints in the file's order, and all channel values; every frame must have the first one's layout."""
    lines = _amc_lines(path, asf)
    beginning = list(islice(lines, 1))
    first, following = [], []
    for number, words in lines:
        if words[0][0].isdecimal():
            following = [(number, words)]
            break
        first.append((number, words))
        if len(first) > MAX_BONES:
            raise WearcapError(f"more than {MAX_BONES} bones", at_line(path, number))
    number = beginning[0][0] if beginning else 1
    names = [words[0] for _, words in first]
    for line, (name, *given) in first:
        if name not in asf.skeleton.joint_names or names.count(name) > 1:
            expected = "bones of the skeleton, once per frame"
            fix = "Check that AMC and ASF belong together."
            raise WearcapError(f"bone {name!r} is not in the ASF, or comes twice", at_line(path, line), expected, fix)
        if len(given) != (expected := len(asf.dof[asf.skeleton.index(name)])):
            raise WearcapError(f"{len(given)} values for {name!r}", at_line(path, line), f"{expected} as in the ASF")
    moving = {name for name, dof in zip(asf.skeleton.joint_names, asf.dof) if dof}
    if not names or moving - set(names):
        what = f"the first frame lacks {sorted(moving - set(names))[:5]}"
        raise WearcapError(what, at_line(path, number), "every bone that has channels in the ASF")
    joints = [asf.skeleton.index(name) for name in names]
    frames, values, place = array("q"), array("d"), 0
    for row, (number, words) in enumerate(chain(beginning, first, following, lines)):
        place = row % (len(first) + 1)
        if place == 0:
            sound = len(words) == 1 and words[0].isdecimal() and len(words[0]) <= 15
            if not sound or (frames and int(words[0]) <= frames[-1]):
                what = f"{' '.join(words)[:60]!r} where a frame number should stand"
                raise WearcapError(what, at_line(path, number), "rising frame numbers")
            frames.append(int(words[0]))
            continue
        like = first[place - 1][1]
        if words[0] != like[0] or len(words) != len(like):
            what = f"{' '.join(words)[:60]!r} differs from the first frame"
            raise WearcapError(what, at_line(path, number), f"{like[0]!r} with {len(like) - 1} values")
        values.extend(finite_floats(words[1:], at_line(path, number)))
    if place < len(first):
        expected = f"{len(first)} bones per frame"
        raise WearcapError("the last frame is cut short", at_line(path, number), expected, "Fetch the file again.")
    return np.array(frames), joints, torch.from_numpy(np.array(values).reshape(len(frames), -1))


def _amc_lines(path: Path, asf: _AsfSkeleton) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines from the first frame on."""
    begun = False
    for number, line in numbered_lines(path):
        words = line.split()
        if not begun and line.strip().upper() == (":DEGREES" if asf.radians else ":RADIANS"):
            raise WearcapError("its angles are in another unit than the ASF's", path, "one unit in both")
        begun = begun or (bool(words) and words[0][0] not in "#:")
        if begun and words:
            yield number, words
