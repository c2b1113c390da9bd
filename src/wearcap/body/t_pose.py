"""The T-pose of any skeleton, whatever its bind pose, which makes rotations of different skeletons comparable."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import Landmarks, landmarks
from wearcap.body.limb_ik import swing_between
from wearcap.body.skeleton import Skeleton

_SPLAY = 0.17
"""Lateral angle (rad) of a bind pose's shins above which its feet are taken to be rolled with them."""


@dataclass(frozen=True)
class TPose:
    """A skeleton in T-pose with its root at the origin: landmarks, rotations and joint positions."""

    marks: Landmarks
    R: Float[Tensor, "joint 3 3"]
    """Rotations from the bind pose."""
    t: Float[Tensor, "joint 3"]

    @property
    def hip_centre(self) -> Float[Tensor, "3"]:
        return (self.t[self.marks.limb["left_leg"][0]] + self.t[self.marks.limb["right_leg"][0]]) / 2


def t_pose(skeleton: Skeleton) -> TPose:
    """The T-pose: legs straight down, arms straight sideways, all else as in the bind pose."""
    marks = landmarks(skeleton)
    rest = skeleton.rest_joints.double()
    aim: dict[int, tuple[Tensor, Tensor]] = {}
    feet = {}
    for name, (first, second, third) in marks.limb.items():
        y = 1.0 if name.startswith("left") else -1.0
        direction = torch.tensor([0.0, 0.0, -1.0] if name.endswith("leg") else [0.0, y, 0.0], dtype=rest.dtype)
        aim[first] = (rest[second] - rest[first], direction)
        aim[second] = (rest[third] - rest[second], direction)
        if name.endswith("leg"):
            feet[third] = aim[second]
    R = [torch.eye(3, dtype=rest.dtype)] * len(skeleton)
    for joint in range(1, len(skeleton)):
        R[joint] = R[skeleton.parents[joint]]
        if joint in aim:
            R[joint] = swing_between(*aim[joint])
        elif joint in feet:
            bone, down = feet[joint]
            splayed = bone[1].abs() > _SPLAY * bone.norm()
            R[joint] = swing_between(bone, down) if splayed else torch.eye(3, dtype=rest.dtype)
    R_t = torch.stack(R)
    local = local_rotations(skeleton, R_t)
    t = forward_kinematics(skeleton, local, torch.zeros(3, dtype=rest.dtype)).t
    return TPose(marks, R_t, t)
