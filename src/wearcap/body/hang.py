"""Hang a pose from a joint whose pose is measured: the body follows, the joint is where it must be."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid


def hang(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "*batch joint 3 3"],
    T_world_measured: Rigid,
    t_parent_joint: Float[Tensor, "*#batch joint 3"] | None = None,
    joint: str = "head",
) -> tuple[Float[Tensor, "*batch joint 3 3"], Rigid]:
    """Match position and orientation of `joint` to `T_world_measured` (thesis §6.2).

    The root keeps its orientation; the joint itself turns against its parent until its world orientation is the
    measured one, and the whole body is shifted. Returns (R_parent_joint, poses of all joints in the world).
    """
    at, parent = skeleton.index(joint), skeleton.parents[skeleton.index(joint)]
    origin = torch.zeros_like(R_parent_joint[..., 0, :, 0])
    T_root_joint = forward_kinematics(skeleton, R_parent_joint, origin, t_parent_joint)
    R_parent_measured = T_root_joint.R[..., parent, :, :].transpose(-1, -2) @ T_world_measured.R
    shift = T_world_measured.t - T_root_joint.t[..., at, :]
    R_hung = torch.cat(
        [
            R_parent_joint[..., :at, :, :],
            R_parent_measured[..., None, :, :],
            R_parent_joint[..., at + 1 :, :, :],
        ],
        dim=-3,
    )
    R_world = torch.cat(
        [
            T_root_joint.R[..., :at, :, :],
            T_world_measured.R[..., None, :, :],
            T_root_joint.R[..., at + 1 :, :, :],
        ],
        dim=-3,
    )
    return R_hung, Rigid(R_world, T_root_joint.t + shift[..., None, :])
