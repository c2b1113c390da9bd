"""Joint angles as gait laboratories report them, after the International Society of Biomechanics (ISB).

Hip and ankle after Wu et al. 2002, knee after Grood & Suntay 1983, shoulder and elbow after Wu et al. 2005, the pelvis in
the world after Baker 2001. A joint coordinate system turns about an axis of the proximal segment, a floating one and one
of the distal segment, which is the Euler sequence of these axes. Segments have ISB's axes: x forward, y up, z right.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.landmarks import t_pose
from wearcap.body.skeleton import SIDES
from wearcap.geometry.light_roma import roma
from wearcap.geometry.rotation import about_axis
from wearcap.recording.motion import Motion

_R_ISB_WORLD = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
"""World (x forward, y left, z up) in ISB's axes."""
_MIRROR = torch.diag(torch.tensor([1.0, 1, -1], dtype=torch.float64))
"""Turns what is left into what is right, in ISB's axes."""
_UPPER_ARM = about_axis("x", torch.tensor(-math.pi / 2, dtype=torch.float64))
"""ISB's axes of the right upper arm in those of a trunk in T-pose, in which it is lifted sideways by 90°."""
_FOREARM = _UPPER_ARM @ about_axis("y", torch.tensor(math.pi / 2, dtype=torch.float64))
"""The same of the forearm, whose palm looks down in T-pose: pronated by 90°."""
_HANGING_DEG = 0.5
"""Elevation up to which an upper arm, and distance from 180° down to which a raised one, has no plane of elevation."""


class Joint(NamedTuple):
    """A joint coordinate system: sequence of axes, and what the angles about them are called, each with its sign."""

    sequence: str
    angles: tuple[tuple[str, float], ...]


CENTRAL = {
    "pelvis": Joint("YXZ", (("left_turn", 1), ("right_drop", 1), ("anterior_tilt", -1))),
    "trunk": Joint("ZXY", (("flexion", -1), ("right_bending", 1), ("left_rotation", 1))),
}
"""The pelvis in the world, and the thorax in the pelvis."""
SIDED = {
    "hip": Joint("ZXY", (("flexion", 1), ("adduction", 1), ("internal_rotation", 1))),
    "knee": Joint("ZXY", (("flexion", -1), ("adduction", 1), ("internal_rotation", 1))),
    "ankle": Joint("ZXY", (("dorsiflexion", 1), ("inversion", 1), ("internal_rotation", 1))),
    "shoulder": Joint("YXY", (("plane_of_elevation", 1), ("elevation", 1), ("internal_rotation", 1))),
    "elbow": Joint("ZXY", (("flexion", 1), ("carrying_angle", 1), ("pronation", 1))),
}
"""Joints of a side; angles of the left side are those of its mirror image."""


def relative_rotations(motion: Motion) -> dict[str, Float64[Tensor, "time 3 3"]]:
    """Rotation of each joint's distal segment in the proximal one (of the pelvis: in the world), in ISB's axes, by name.

    Those of the left side (`left_hip`) are mirrored, so that each is the right side's. Axes of pelvis, thorax and foot are
    those of a person who stands straight in T-pose, palms down; long axes of limbs run through the joints' centres,
    mediolateral ones are the skeleton's. Raises WearcapError where limbs are not recognised.
    """
    pose = t_pose(motion.skeleton)
    marks, R = pose.marks, motion.T_world_joint.R.double() @ pose.R.mT
    R = _R_ISB_WORLD @ R @ _R_ISB_WORLD.mT
    pelvis, thorax = R[:, marks.root], R[:, marks.spine[-1]]
    found = {"pelvis": pelvis, "trunk": pelvis.mT @ thorax}
    for side in SIDES:
        thigh, shank, foot = (R[:, joint] for joint in marks.limb[f"{side}_leg"])
        upper, forearm = R[:, marks.limb[f"{side}_arm"][0]], R[:, marks.forearm[side]]
        joints = {
            "hip": pelvis.mT @ thigh,
            "knee": thigh.mT @ shank,
            "ankle": shank.mT @ foot,
            "shoulder": thorax.mT @ upper,
            "elbow": upper.mT @ forearm,
        }
        if side == "left":
            joints = {name: _MIRROR @ joint @ _MIRROR for name, joint in joints.items()}
        joints["shoulder"] = joints["shoulder"] @ _UPPER_ARM
        joints["elbow"] = _UPPER_ARM.mT @ joints["elbow"] @ _FOREARM
        found |= {f"{side}_{name}": joint for name, joint in joints.items()}
    return found


def euler_deg(sequence: str, R: Float64[Tensor, "time 3 3"]) -> tuple[Float64[Tensor, "time"], ...]:
    """Angles (degrees, -180 to 180) of turns about moving axes, one after the other.

    In gimbal lock the last of a sequence of three axes is 0. YXY is a shoulder's: elevation is ISB's without its minus sign, and an
    arm that hangs or points up has no plane of elevation: it is 0, and all rotation is the last angle.
    """
    first, second, third = roma.rotmat_to_euler(sequence, R, as_tuple=True, degrees=True)
    if sequence != "YXY":
        return first, second, third
    # (a, b, c) and (a + 180, -b, c + 180) are the same: ISB has the second one, b < 0.
    lost = (second < _HANGING_DEG) | (second > 180 - _HANGING_DEG)
    whole = torch.where(second < 90, first + third, third - first)
    plane = torch.where(lost, 0.0, first + 180)
    return _wrapped(plane), second, _wrapped(torch.where(lost, whole, third + 180))


def joint_angles(motion: Motion) -> dict[str, Float[Tensor, "time"]]:
    """Angles (degrees) by name: `left_hip_flexion`, …, `trunk_flexion`, `pelvis_anterior_tilt`; docs/gait.md defines each.

    Raises WearcapError as `relative_rotations` does.
    """
    found = {}
    for name, R in relative_rotations(motion).items():
        joint = CENTRAL.get(name) or SIDED[name.partition("_")[2]]
        for (angle, sign), values in zip(joint.angles, euler_deg(joint.sequence, R)):
            found[f"{name}_{angle}"] = sign * values
    return found


def _wrapped(angle: Tensor) -> Tensor:
    return (angle + 180) % 360 - 180
