"""Analytic inverse kinematics of a limb of two bones with a hinge between them (leg, arm)."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation

REACH = 0.9995
"""A limb straightens to this share of its length; the rest keeps knee and elbow from snapping."""


def two_bone(
    upper: Float[Tensor, "3"],
    lower: Float[Tensor, "3"],
    hinge: Float[Tensor, "3"],
    target: Float[Tensor, "time 3"],
    pole: Float[Tensor, "time 3"],
) -> tuple[Float[Tensor, "time 3 3"], Float[Tensor, "time"]]:
    """Rotation of the upper bone in the world and bend (rad) of the hinge that bring the limb's end to `target`.

    `upper` and `lower` are the bones' offsets in the rest pose, `hinge` the unit axis that bends the limb, all in the
    rest axes; `target` is the limb's end seen from its root and `pole` the side to which the middle joint points, both
    in the world. A target out of reach is approached along its direction. |upper + R(bend) lower| = |target| is
    solved in closed form: A cos bend + B sin bend = K.
    """
    along = upper @ hinge * (lower @ hinge)
    A = upper @ lower - along
    B = upper @ torch.linalg.cross(hinge, lower)
    size, phase = torch.sqrt(A * A + B * B), torch.atan2(B, A)
    straight = torch.sqrt(upper @ upper + lower @ lower + 2 * (along + size))
    distance = target.norm(dim=-1).clamp(max=REACH * straight)
    K = (distance**2 - upper @ upper - lower @ lower) / 2 - along
    bend = phase + torch.acos((K / size).clamp(-1.0, 1.0))
    end = upper + (rotation.exp(bend[:, None] * hinge) @ lower[:, None])[..., 0]
    e = torch.nn.functional.normalize(target, dim=-1)
    n = torch.nn.functional.normalize(torch.linalg.cross(pole, e), dim=-1)
    R_world = _frame(e, n)
    R_rest = _frame(torch.nn.functional.normalize(end, dim=-1), hinge.expand_as(end))
    return R_world @ R_rest.transpose(-1, -2), bend


def _frame(first: Tensor, second: Tensor) -> Tensor:
    """Orthonormal axes: `first` (a unit vector), `second` made perpendicular to it, and their cross product."""
    second = second - (second * first).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)
