"""Anchor a body to its measured head, and move a hand to a measured position."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.retarget import reach
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion


def anchor(
    skeleton: Skeleton, R_parent_joint: Float[Tensor, "*batch joint 3 3"], T_world_measured: Rigid
) -> tuple[Float[Tensor, "*batch joint 3 3"], Rigid]:
    """Match position and orientation of the head joint to `T_world_measured` (thesis §6.2).

    The root keeps its orientation; the head's local rotation is set so that its world orientation is the measured
    one, and the whole body is translated. Returns (R_parent_joint, world poses of all joints).
    """
    at = skeleton.index("head")
    parent = skeleton.parents[at]
    T_root_joint = forward_kinematics(skeleton, R_parent_joint, torch.zeros_like(R_parent_joint[..., 0, :, 0]))
    R_parent_measured = T_root_joint.R[..., parent, :, :].transpose(-1, -2) @ T_world_measured.R
    shift = T_world_measured.t - T_root_joint.t[..., at, :]
    R_anchored, R_world = (
        torch.cat([R[..., :at, :, :], R_head[..., None, :, :], R[..., at + 1 :, :, :]], dim=-3)
        for R, R_head in ((R_parent_joint, R_parent_measured), (T_root_joint.R, T_world_measured.R))
    )
    return R_anchored, Rigid(R_world, T_root_joint.t + shift[..., None, :])


def anchored_to_head(motion: Motion, T_world_head: Rigid) -> Motion:
    """The motion with its head joint at the measured poses: the body is translated, the head joint rotated."""
    R_parent_joint, T_world_joint = anchor(motion.skeleton, motion.R_parent_joint, T_world_head)
    return replace(motion, R_parent_joint=R_parent_joint, t_world_root=T_world_joint.t[:, 0])


def with_hand_moved(motion: Motion, side: str, offset: Float[Tensor, "time 3"]) -> Motion:
    """The motion with one wrist moved by an offset in the world (m), shoulder and elbow following."""
    skeleton, T = motion.skeleton, motion.T_world_joint
    shoulder, elbow, wrist = skeleton.indices(*(f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist")))
    # Double precision, as the bend of a nearly straight arm is the root of a small difference of squares.
    start, middle, end = (T.t[:, joint].double() for joint in (shoulder, elbow, wrist))
    upper, lower = (turn.to(T.R) for turn in reach(start, middle, end, end + offset.double()))
    R = T.R.clone()
    R[:, shoulder], R[:, elbow] = upper @ R[:, shoulder], lower @ R[:, elbow]
    return replace(motion, R_parent_joint=local_rotations(skeleton, R))
