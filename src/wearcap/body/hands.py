"""Hands: the layout of tracked finger joints, the angles of fingers, and SMPL+H's finger joints on any skeleton.

All is written for a left hand in the wrist joint's rest axes: x to the thumb's side, y along the fingers, z out of the back of
the hand (m). A right hand is its mirror image (y negated). A finger at rest is straight; its own axes are y along it, z out of
its back, and x, about which it bends. Five angles (rad) pose it, R1 = Rz(-abduction) Rx(-flexion) Ry(twist) of its first bone
and R2, R3 = Rx(-flexion) of the next two: abduction is towards the thumb's side, flexion towards the palm.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.landmarks import t_pose
from wearcap.body.skeleton import MIRROR, SIDES, WRISTS, Site, Skeleton
from wearcap.body.skeletons import FINGERS, smplh52
from wearcap.geometry.rotation import about_axis

FINGER_NAMES = ("thumb", "index", "middle", "ring", "pinky")
"""Order of fingers in all arrays; that of SMPL+H's joints is `skeletons.FINGERS`."""
_BONES = ("metacarpal", "proximal", "intermediate", "distal", "tip")
HAND_JOINTS = (
    "wrist",
    *(f"{name}_{bone}" for name in FINGER_NAMES for bone in _BONES if (name, bone) != ("thumb", "intermediate")),
)
"""The 25 joints of a tracked hand, OpenXR's but for the palm: "thumb_metacarpal" is the thumb's CMC joint, "index_proximal"
a knuckle (MCP), "index_intermediate" a PIP and "index_distal" a DIP joint."""
OPENXR = ("palm", *HAND_JOINTS)
"""The order of XR_EXT_hand_tracking's 26 joints; WebXR's 25 are `HAND_JOINTS`."""
MEDIAPIPE = tuple(name for name in HAND_JOINTS if not name.endswith("_metacarpal") or name.startswith("thumb"))
"""The order of MediaPipe's 21 landmarks."""
CHAINS = tuple(tuple(HAND_JOINTS.index(f"{name}_tip") - k for k in (3, 2, 1, 0)) for name in FINGER_NAMES)
"""Of each finger in `HAND_JOINTS`: start of its first bone, of the next two, and tip."""
PALM = (0, *(chain[0] for chain in CHAINS[1:]))
"""Wrist and knuckles in `HAND_JOINTS`: the palm, which is rigid."""

_FINGER_LIMITS = ((-30, 30), (-30, 100), (0, 0), (-10, 115), (-15, 90))
_THUMB_LIMITS = ((-45, 60), (-50, 60), (-60, 60), (-20, 80), (-30, 95))
LIMITS = torch.tensor([_THUMB_LIMITS, *[_FINGER_LIMITS] * 4], dtype=torch.float64).deg2rad()
"""Least and greatest of each finger's abduction, flexion, twist and two more flexions, "finger angle 2" (rad): PIP and DIP bend about one axis, knuckles about two;
the thumb's CMC turns about three, within the range of healthy hands (our choice, generous by some 10°)."""
REST = torch.tensor(
    [(0, 10, 0, 15, 15), (4, 18, 0, 25, 12), (0, 22, 0, 28, 14), (-3, 25, 0, 30, 15), (-6, 27, 0, 30, 15)],
    dtype=torch.float64,
).deg2rad()  # fmt: skip
"""A relaxed hand's angles, "finger angle" (rad)."""
_THUMB_ROLL = 60.0
"""Angle (°) about the thumb by which its back is turned from the hand's towards its own side (nominal)."""
TIP_SHARE = 0.8
"""Length of a last bone over that of the bone before it, where no tip is known."""


def finger_joints(side: str, finger: str) -> tuple[str, str, str]:
    """Names of SMPL+H's joints of a finger."""
    return f"{side}_{finger}1", f"{side}_{finger}2", f"{side}_{finger}3"


class HandShape(NamedTuple):
    """Bones of a hand (m), as of a left one."""

    knuckles: Float[Tensor, "finger 3"]
    """Start of each finger's first bone in the wrist joint's axes."""
    bones: Float[Tensor, "finger 3"]
    """Lengths of the bones, the last one out to the tip."""

    def scaled(self, scale: float) -> "HandShape":
        return HandShape(scale * self.knuckles, scale * self.bones)


@cache
def default_shape() -> HandShape:
    """The hand of `smplh52`."""
    offsets = dict(zip(smplh52().joint_names, smplh52().t_parent_joint.double()))
    first, second, third = (torch.stack([offsets[f"left_{name}{k}"] for name in FINGER_NAMES]) for k in (1, 2, 3))
    lengths = second.norm(dim=-1), third.norm(dim=-1), TIP_SHARE * third.norm(dim=-1)
    return HandShape(first, torch.stack(lengths, -1))


@cache
def finger_axes() -> Float[Tensor, "finger 3 3"]:
    """Axes of straight left fingers as columns: those of the hand, but for the thumb, which lies aslant and rolled."""
    y = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    roll = torch.tensor(_THUMB_ROLL, dtype=torch.float64).deg2rad()
    z = torch.stack([0.8 * roll.sin(), -0.6 * roll.sin(), roll.cos()])
    thumb = torch.stack([torch.linalg.cross(y, z), y, z], -1)
    return torch.stack([thumb, *[torch.eye(3, dtype=torch.float64)] * 4])


def finger_rotations(angles: Float[Tensor, "*batch finger 5"], side: str) -> Float[Tensor, "*batch finger 3 3 3"]:
    """Rotations of each finger's three joints relative to their parents, in the wrist joint's rest axes."""
    abduction, first, twist, second, third = angles.unbind(-1)
    base = about_axis("z", -abduction) @ about_axis("x", -first) @ about_axis("y", twist)
    F = finger_axes().to(angles)[:, None]
    R = F @ torch.stack([base, about_axis("x", -second), about_axis("x", -third)], -3) @ F.mT
    mirror = torch.diag(R.new_tensor(MIRROR))
    return R if side == "left" else mirror @ R @ mirror


def in_layout(points: Float[Tensor, "time point 3"], names: Sequence[str]) -> Float[Tensor, "time joint 3"]:
    """Places by `HAND_JOINTS`, NaN for those that are not among `names`; names that the layout lacks are left out."""
    found = points.new_full((len(points), len(HAND_JOINTS), 3), torch.nan)
    known = [k for k, name in enumerate(names) if name in HAND_JOINTS]
    found[:, [HAND_JOINTS.index(names[k]) for k in known]] = points[:, known]
    return found


def has_fingers(skeleton: Skeleton) -> bool:
    return all(finger_joints(side, "index")[0] in skeleton for side in SIDES)


def scaled_shape(skeleton: Skeleton) -> HandShape:
    """The default hand at the size of a skeleton's forearms."""
    ours, theirs = (each.t_parent_joint[each.indices(*WRISTS)].norm(dim=-1).mean() for each in (skeleton, smplh52()))
    return default_shape().scaled((ours / theirs).item())


def with_finger_joints(skeleton: Skeleton, shapes: Mapping[str, HandShape]) -> Skeleton:
    """The skeleton with SMPL+H's 15 finger joints on each wrist, of the `shapes` by side, and a site at each tip."""
    rest, mirror = t_pose(skeleton).R, torch.tensor(MIRROR, dtype=torch.float64)
    names, parents = list(skeleton.joint_names), list(skeleton.parents)
    offsets, sites = [skeleton.t_parent_joint.double()], dict(skeleton.sites)
    for side in SIDES:
        wrist, shape = skeleton.index(f"{side}_wrist"), shapes[side]
        for finger in FINGERS:
            row, joints = FINGER_NAMES.index(finger), finger_joints(side, finger)
            places = torch.cat([shape.knuckles[row, None], shape.bones[row, :, None] * finger_axes()[row, :, 1]])
            places = (places if side == "left" else places * mirror) @ rest[wrist]  # into the wrist's bind axes
            parents += [wrist, len(names), len(names) + 1]
            names += joints
            offsets.append(places[:3])
            x, y, z = places[3].tolist()
            sites[f"{side}_{finger}_tip"] = Site(joints[2], (x, y, z))
        sites.pop(f"{side}_fingertip", None)  # of a hand without fingers
    return Skeleton(f"{skeleton.name}+fingers", tuple(names), tuple(parents), torch.cat(offsets).float(), sites)


def with_finger_rotations(
    R_parent_joint: Float[Tensor, "time joint 3 3"],
    skeleton: Skeleton,
    angles: Mapping[str, Float[Tensor, "time finger 5"]],
) -> Float[Tensor, "time joint_t 3 3"]:
    """The body's rotations with those of the fingers behind them, in the order of `with_finger_joints`; `skeleton` is the body's."""
    rest, parts = t_pose(skeleton).R, [R_parent_joint]
    order = [FINGER_NAMES.index(finger) for finger in FINGERS]
    for side in SIDES:
        R_wrist = rest[skeleton.index(f"{side}_wrist")]
        turned = R_wrist.mT @ finger_rotations(angles[side], side)[:, order] @ R_wrist
        parts.append(turned.flatten(1, 2).to(R_parent_joint))
    return torch.cat(parts, 1)
