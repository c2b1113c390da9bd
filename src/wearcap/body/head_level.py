"""The facing direction of a captured head whose frame was not aligned with the face."""

import math

from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.limb_ik import swing_between
from wearcap.body.skeleton import Skeleton

UPRIGHT = math.cos(math.radians(25))
NATURAL_PITCH = math.radians(7)
"""Average downward pitch of the head of an upright person (ours)."""


def head_level(
    skeleton: Skeleton, R_parent_joint: Float[Tensor, "time joint 3 3"], at_least: int = 30
) -> Float[Tensor, "3 3"] | None:
    """R_head_face: the constant tilt of the face in the head joint's axes, found from the upright frames.

    Marker sets such as CMU's leave the head frame pitched by 5…45°, by subject. Over frames whose pelvis is
    upright, the face is taken to look 7° down in the median and not to lean sideways; heading is not touched.
    None if fewer than `at_least` frames are upright. For subjects with many motions, average the results.
    """
    origin = R_parent_joint.new_zeros(len(R_parent_joint), 3)
    R_world = forward_kinematics(skeleton, R_parent_joint, origin).R
    upright = R_world[:, 0, 2, 2] > UPRIGHT
    if int(upright.sum()) < at_least:
        return None
    up_head = R_world[upright, skeleton.index("head")][:, 2, :].median(0).values
    sin, cos = math.sin(NATURAL_PITCH), math.cos(NATURAL_PITCH)
    return swing_between(up_head.new_tensor([-sin, 0.0, cos]), up_head)


def with_head_face(
    skeleton: Skeleton, R_parent_joint: Float[Tensor, "*batch joint 3 3"], R_head_face: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch joint 3 3"]:
    """The motion with the head joint's axes rotated to the face's; joints above the head are unchanged."""
    origin = R_parent_joint.new_zeros(*R_parent_joint.shape[:-3], 3)
    R_world = forward_kinematics(skeleton, R_parent_joint, origin).R.clone()
    head = skeleton.index("head")
    R_world[..., head, :, :] = R_world[..., head, :, :] @ R_head_face.to(R_world)
    return local_rotations(skeleton, R_world)
