"""How far rebuilt voxel grids are from the true ones. Pure functions on tensors; a cell nearer than `clip_m` is held."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.metrics.position import CM_PER_M

_ROUNDING = 1e-3
"""Share of `clip_m` by which a distance has to lie below it: half-precision files round."""


def distance_mae_cm(grids: Float[Tensor, "*batch"], grids_true: Float[Tensor, "*batch"]) -> Float[Tensor, ""]:
    """Mean absolute error (cm) of the truncated distances (m), over all cells."""
    return (grids - grids_true).abs().mean() * CM_PER_M


def held_distance_mae_cm(
    grids: Float[Tensor, "*batch"], grids_true: Float[Tensor, "*batch"], clip_m: float
) -> Float[Tensor, ""]:
    """The same over the cells that truly hold a point: the others are nearly all, and alike."""
    held = grids_true < clip_m * (1 - _ROUNDING)
    return distance_mae_cm(grids[held], grids_true[held])


def occupancy_iou(
    grids: Float[Tensor, "*batch"], grids_true: Float[Tensor, "*batch"], clip_m: float, border_m: float | None = None
) -> Float[Tensor, ""]:  # fmt: skip
    """Intersection over union of the cells that hold a point, over all grids together (1 where no cell does).

    A rebuilt cell holds one if it is nearer than `border_m`, which is `clip_m` unless told otherwise.
    """
    limit = clip_m * (1 - _ROUNDING)
    held, held_true = grids < (limit if border_m is None else border_m), grids_true < limit
    union = (held | held_true).sum()
    return torch.where(union > 0, (held & held_true).sum() / union.clamp_min(1), 1.0)
