"""Skeletons by joint name.

In the named skeletons (xsens23 and SMPL's) the rest pose (all `R_parent_joint` identity) is a T-pose that faces
+x, with +y to its left and +z up, and all joint frames are parallel to the world. Skeletons read from files keep
their bind pose as rest, in the same axes; `retarget` reconciles the two. Offsets are in metres.
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError

SIDES = ("left", "right")
FOOT_PATCHES = ("left_heel", "left_toe_tip", "right_heel", "right_toe_tip")
"""Sites with floor contact labels and predictions, always in this order."""

FEET = 2
"""Number of feet: contacts by foot come in the order left, right."""
FOOT_JOINTS = ("left_toe", "right_toe")
"""Joint of each foot whose position and contact stand for the foot's."""
WRISTS = ("left_wrist", "right_wrist")

MIRROR = (1.0, -1.0, 1.0)
"""Factors that mirror a position left to right: y changes its sign."""

_ALIASES = {
    "left_toe": "left_foot",
    "right_toe": "right_foot",
    "left_foot": "left_toe",
    "right_foot": "right_toe",
    "left_collar": "left_clavicle",
    "right_collar": "right_clavicle",
}
"""Aliases of joint names: other skeletons' names for the same joint, used if the first name is absent."""


@dataclass(frozen=True)
class Site:
    """A named point that moves with a joint: heel, toe tip, fingertip, crown."""

    joint: str
    t_joint_site: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A tree of joints; parents come before their children, the root first with parent -1."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    t_parent_joint: Float[Tensor, "joint 3"]
    sites: dict[str, Site] = field(default_factory=dict)

    def __post_init__(self):
        if len(self.joint_names) != len(self.parents) or len(self.parents) != len(self.t_parent_joint):
            raise WearcapError(
                f"skeleton {self.name!r} has {len(self.joint_names)} names, {len(self.parents)} parents and "
                f"{len(self.t_parent_joint)} offsets",
                expected="one of each per joint",
            )
        for joint, parent in enumerate(self.parents):
            if not (parent == -1 if joint == 0 else 0 <= parent < joint):
                what = f"joint {self.joint_names[joint]!r} of skeleton {self.name!r} has parent {parent}"
                raise WearcapError(what, expected="the root first (parent -1) and every parent before its children")
        if len(set(self.joint_names)) != len(self.joint_names):
            raise WearcapError(f"skeleton {self.name!r} names a joint twice", expected="unique joint names")

    def __len__(self) -> int:
        return len(self.joint_names)

    def __eq__(self, other) -> bool:
        return (
            isinstance(other, Skeleton)
            and (self.name, self.joint_names, self.parents, self.sites)
            == (other.name, other.joint_names, other.parents, other.sites)
            and torch.equal(self.t_parent_joint, other.t_parent_joint)
        )

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def _index_of(self) -> dict[str, int]:
        return {name: joint for joint, name in enumerate(self.joint_names)}

    def index(self, name: str) -> int:
        """Position of a joint by name. Raises WearcapError with the nearest names when it is absent."""
        for candidate in (name, _ALIASES.get(name, name)):
            if candidate in self._index_of:
                return self._index_of[candidate]
        near = ", ".join(difflib.get_close_matches(name, self.joint_names, n=3, cutoff=0.3))
        what = f"skeleton {self.name!r} has no joint {name!r}"
        raise WearcapError(what, expected=f"one like {near or self.joint_names}")

    def indices(self, *names: str) -> list[int]:
        """Positions of joints by name. Raises WearcapError as `index` does."""
        return [self.index(name) for name in names]

    def __contains__(self, name: str) -> bool:
        return name in self._index_of or _ALIASES.get(name) in self._index_of

    def ancestors(self, joint: int) -> list[int]:
        """The joint and all its ancestors, the root last."""
        return ancestors(self.parents, joint)

    @cached_property
    def rest_joints(self) -> Float[Tensor, "joint 3"]:
        """Joint positions of the rest pose with the root at the origin (m)."""
        positions = [self.t_parent_joint[0] * 0]
        for joint in range(1, len(self)):
            positions.append(positions[self.parents[joint]] + self.t_parent_joint[joint])
        return torch.stack(positions)

    @cached_property
    def rest_sites(self) -> dict[str, Tensor]:
        """Site positions of the rest pose with the root at the origin (m)."""
        return {
            name: self.rest_joints[self.index(site.joint)] + torch.tensor(site.t_joint_site)
            for name, site in self.sites.items()
        }

    @property
    def root_height(self) -> float:
        """Height of the root above the floor when standing in the rest pose (m)."""
        lowest = min(p[2].item() for p in (*self.rest_joints, *self.rest_sites.values()))
        return -lowest

    @property
    def stature(self) -> float:
        """Height (m) of a person with this skeleton, from soles to crown."""
        points = self.rest_sites.values()
        top = max([self.rest_joints[:, 2].max().item(), *(point[2].item() for point in points)])
        return top + self.root_height

    def height_of(self, joint: str) -> float:
        """Height of a joint above the floor in the rest pose (m)."""
        return self.rest_joints[self.index(joint), 2].item() + self.root_height

    def with_offsets(self, t_parent_joint: Float[Tensor, "joint 3"]) -> "Skeleton":
        """The same tree with other bone offsets; sites scale with their joint's own or parent bone."""
        old = self.t_parent_joint.norm(dim=-1).sum()
        scale = (t_parent_joint.norm(dim=-1).sum() / old).item()
        sites = {
            name: Site(site.joint, tuple(scale * v for v in site.t_joint_site)) for name, site in self.sites.items()
        }
        return replace(self, t_parent_joint=t_parent_joint, sites=sites)

    def scaled(self, scale: float) -> "Skeleton":
        """The skeleton with all bones and sites scaled by one factor."""
        return self.with_offsets(self.t_parent_joint * scale)


def levels_of(parents: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Joints by depth in the tree, the root's level first, for one batched step per level."""
    depth = [0] * len(parents)
    for joint in range(1, len(parents)):
        depth[joint] = depth[parents[joint]] + 1
    return tuple(tuple(j for j in range(len(parents)) if depth[j] == level) for level in range(max(depth) + 1))


def ancestors(parents: Sequence[int], joint: int) -> list[int]:
    """The joint and all its ancestors, the root last; nothing for a joint below 0."""
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = parents[joint]
    return chain


def mirrored(rows: Sequence) -> list[tuple[str, str, tuple[float, float, float]]]:
    """The right side's rows (y negated, left→right in names) for rows that describe the left side."""
    return [(n.replace("left", "right"), p.replace("left", "right"), (x, -y, z)) for n, p, (x, y, z) in rows]


def build_skeleton(name: str, rows: Sequence, left_toe: str | None = None) -> Skeleton:
    """A skeleton from rows (joint, parent, offset), with sites where `left_toe` names the joint of the left toes."""
    names = tuple(row[0] for row in rows)
    parents = tuple(names.index(row[1]) if row[1] else -1 for row in rows)
    skeleton = Skeleton(name, names, parents, torch.tensor([row[2] for row in rows]))
    if left_toe is None:
        return skeleton
    left = [
        ("left_heel", "left_ankle", (-0.050, 0.0, -0.080)), ("left_toe_tip", left_toe, (0.070, 0.0, -0.018)),
        ("left_fingertip", "left_wrist", (0.0, 0.185, 0.0)), ("left_palm", "left_wrist", (0.0, 0.080, -0.015)),
    ]  # fmt: skip
    sites = {site: Site(joint, offset) for site, joint, offset in [*left, *mirrored(left)]}
    return replace(skeleton, sites=sites | {"crown": Site("head", (0.02, 0.0, 0.185))})


def xsens23() -> Skeleton:
    """Xsens MVN's 23 segments, named by the joint at each segment's origin, at the size of a 1.75 m adult."""
    arm = [
        ("left_collar", "t8", (0.0, 0.035, 0.085)), ("left_shoulder", "left_collar", (0.0, 0.145, 0.0)),
        ("left_elbow", "left_shoulder", (0.0, 0.290, 0.0)), ("left_wrist", "left_elbow", (0.0, 0.250, 0.0)),
    ]  # fmt: skip
    leg = [
        ("left_hip", "pelvis", (0.0, 0.085, 0.0)), ("left_knee", "left_hip", (0.0, 0.0, -0.430)),
        ("left_ankle", "left_knee", (0.0, 0.0, -0.420)), ("left_toe", "left_ankle", (0.155, 0.0, -0.062)),
    ]  # fmt: skip
    spine = [
        ("pelvis", "", (0.0, 0.0, 0.0)), ("l5", "pelvis", (0.0, 0.0, 0.095)), ("l3", "l5", (0.0, 0.0, 0.105)),
        ("t12", "l3", (0.0, 0.0, 0.095)), ("t8", "t12", (0.0, 0.0, 0.095)), ("neck", "t8", (0.0, 0.0, 0.135)),
        ("head", "neck", (0.0, 0.0, 0.090)),
    ]  # fmt: skip
    rows = [*spine, *mirrored(arm), *arm, *mirrored(leg), *leg]
    return build_skeleton("xsens23", rows, "left_toe")


def skeleton_of_height(height_m: float, skeleton: Skeleton | None = None) -> Skeleton:
    """A skeleton (xsens23 by default) scaled to a person's height. Raises WearcapError outside 0.5…2.6 m."""
    if not 0.5 <= height_m <= 2.6:
        raise WearcapError(f"a height of {height_m} m", expected="0.5 to 2.6 m")
    skeleton = skeleton or xsens23()
    return skeleton.scaled(height_m / skeleton.stature)
