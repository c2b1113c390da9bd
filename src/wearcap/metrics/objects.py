"""Errors of object motion, joint velocity and foot contact as in ECHO's tables (ECHO eq. 14–17, §9).

Inputs in metres; results in cm, mm and degrees.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import geodesic, quat_wxyz_from_matrix

ANKLE_M, TOE_M = 0.10, 0.05
"""Heights (m) above the floor below which an ankle and a toe joint are in contact (ECHO §9)."""


def vertex_error_cm(T_found: Rigid, T_true: Rigid, vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, "*batch"]:
    """E_v2v (eq. 16): mean position error (cm) of an object's vertices, which are given in its own axes."""
    turn, shift = T_found.R - T_true.R, T_found.t - T_true.t
    return 100 * (vertices @ turn.mT + shift[..., None, :]).norm(dim=-1).mean(-1)


def center_error_cm(T_found: Rigid, T_true: Rigid, vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, "*batch"]:
    """E_c (eq. 17): position error (cm) of the vertices' mean."""
    center = vertices.mean(0)
    return 100 * (T_found @ center - T_true @ center).norm(dim=-1)  # pyright: ignore[reportOperatorIssue]


def rotation_difference_deg(T_found: Rigid, T_true: Rigid) -> Float[Tensor, "*batch"]:
    """Angle (degrees) between the captured and the true orientation."""
    return geodesic(T_found.R, T_true.R).rad2deg()


def quaternion_difference(T_found: Rigid, T_true: Rigid) -> Float[Tensor, "*batch"]:
    """L1 distance of unit quaternions with non-negative scalar part (ECHO does not define the sign)."""
    found, true = (quat_wxyz_from_matrix(T.R) for T in (T_found, T_true))
    return (found - true).abs().sum(-1)


def joint_step_error_mm(
    joints: Float[Tensor, "time joint 3"], joints_true: Float[Tensor, "time joint 3"]
) -> Float[Tensor, ""]:
    """MPJVE (eq. 15): mean error (mm per frame) of the joints' displacements from frame to frame."""
    return 1000 * (joints - joints_true).diff(dim=0).norm(dim=-1).mean()


def foot_contact_share(
    skeleton: Skeleton, joints: Float[Tensor, "time joint 3"], floor_height: Float[Tensor, "time"]
) -> Float[Tensor, ""]:
    """FC: share of frames in which an ankle is less than 10 cm, or a toe joint less than 5 cm, above the floor."""
    return feet_down(skeleton, joints, floor_height).float().mean()


def feet_down(
    skeleton: Skeleton, joints: Float[Tensor, "time joint 3"], floor_height: Float[Tensor, "time"]
) -> Bool[Tensor, "time"]:
    """Whether any of the four foot joints is below its contact height."""
    low = []
    for name, limit in (("ankle", ANKLE_M), ("toe", TOE_M)):
        at = skeleton.indices(f"left_{name}", f"right_{name}")
        low.append(joints[:, at, 2] - floor_height[:, None] < limit)
    return torch.cat(low, 1).any(1)
