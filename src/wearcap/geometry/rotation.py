"""Rotations: matrices in computation, 6D into networks, quaternions and axis-angle only at interfaces.

Every function is batched over leading axes and differentiable, at the identity and near π too (RoMa).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry.light_roma import roma


def exp(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of an axis-angle vector (rad)."""
    return roma.rotvec_to_rotmat(rotvec)


def log(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vector (rad, norm at most π) of a rotation matrix."""
    return roma.rotmat_to_rotvec(R)


def rot6d_from_matrix(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """First two columns of the matrix, one after the other (thesis §6, Zhou et al. 2019)."""
    return R[..., :2].transpose(-1, -2).flatten(-2)


def matrix_from_rot6d(rot6d: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Gram–Schmidt of two 3-vectors into a rotation matrix; any non-parallel pair is accepted."""
    x = torch.nn.functional.normalize(rot6d[..., :3], dim=-1)
    y = rot6d[..., 3:] - (x * rot6d[..., 3:]).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(y, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def matrix_from_quat_wxyz(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a quaternion, scalar first; normalised here."""
    xyzw = torch.nn.functional.normalize(quat_wxyz, dim=-1).roll(-1, dims=-1)
    return roma.unitquat_to_rotmat(xyzw)


def quat_wxyz_from_matrix(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion with a non-negative scalar part, scalar first."""
    wxyz = roma.rotmat_to_unitquat(R).roll(1, dims=-1)
    return torch.where(wxyz[..., :1] < 0, -wxyz, wxyz)


def geodesic(R_a: Float[Tensor, "*batch 3 3"], R_b: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Angle between two rotations (rad, 0…π), accurate and with finite gradient at 0 and π too."""
    turn = R_a.transpose(-1, -2) @ R_b
    # atan2 of sine and cosine; acos or asin alone loses half the digits at one end
    axis = torch.stack([turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
    return torch.atan2(axis.norm(dim=-1), turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


def between(
    R_a: Float[Tensor, "*#batch 3 3"], R_b: Float[Tensor, "*#batch 3 3"], share: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation at a share (0…1) of the turn from R_a to R_b."""
    return R_a @ exp(share[..., None] * log(R_a.mT @ R_b))


def about_axis(axis: str, angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by `angle` (rad) about the named axis "x", "y" or "z"."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    entries = {(i, i): one, (j, j): cos, (k, k): cos, (k, j): sin, (j, k): -sin}
    rows = [torch.stack([entries.get((row, column), zero) for column in range(3)], -1) for row in range(3)]
    return torch.stack(rows, -2)


def yaw_of(R_world_body: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Heading (rad) about the vertical: direction in which the body's x axis points.

    Where x is nearly vertical (|x_z| > 0.9: looking straight up or down) the body's z axis is used, which then points
    along or against the heading; so a head that bends down keeps its heading.
    """
    forward, up = R_world_body[..., 0], R_world_body[..., 2]
    steep = forward[..., 2:].abs() > 0.9
    heading = torch.where(steep, -up * forward[..., 2:].sign(), forward)
    return torch.atan2(heading[..., 1], heading[..., 0])


def wrap_angle(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same angle in [-π, π)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def nearest_rotation(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation nearest to a matrix: of a sum of rotations, their chordal mean."""
    return roma.special_procrustes(matrix)  # pyright: ignore[reportReturnType]


def mean_rotation(R: Float[Tensor, "sample 3 3"]) -> Float[Tensor, "3 3"]:
    """Chordal mean: the rotation nearest to the arithmetic mean of the matrices."""
    return nearest_rotation(R.mean(0))


def swing_between(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The smallest rotation that turns direction a onto direction b (any lengths; opposite ones: half a turn)."""
    a, b = torch.broadcast_tensors(a, b)
    a, b = torch.nn.functional.normalize(a, dim=-1), torch.nn.functional.normalize(b, dim=-1)
    cos = (a * b).sum(-1)[..., None, None]
    v = torch.linalg.cross(a, b)
    zero = torch.zeros_like(v[..., 0])
    K = torch.stack([zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero], -1)
    K = K.unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    swing, opposite = eye + K + K @ K / (1 + cos).clamp_min(1e-6), cos < -1 + 1e-6
    if not opposite.any():
        return swing
    across = torch.linalg.cross(a, eye[a.abs().argmin(-1)])
    across = torch.nn.functional.normalize(across, dim=-1)[..., None]
    half_turn = 2 * across @ across.transpose(-1, -2) - eye
    return torch.where(opposite, half_turn, swing)
