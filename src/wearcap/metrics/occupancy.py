"""Errors of reconstructed voxel grids of truncated distances; a cell with a distance below `clip_m` is occupied."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.metrics.position import CM_PER_M

_ROUNDING = 1e-3
"""Margin below `clip_m`, as a share of it, for the rounding of half-precision files."""


def distance_mae_cm(grids: Float[Tensor, "*batch"], grids_true: Float[Tensor, "*batch"]) -> Float[Tensor, ""]:
    """Mean absolute error (cm) of the truncated distances (m), over all cells."""
    return (grids - grids_true).abs().mean() * CM_PER_M


def occupied_distance_mae_cm(
    grids: Float[Tensor, "*batch"], grids_true: Float[Tensor, "*batch"], clip_m: float
) -> Float[Tensor, ""]:
    """Mean absolute error (cm) over truly occupied cells, as empty cells would dominate the mean."""
    occupied = grids_true < clip_m * (1 - _ROUNDING)
    return distance_mae_cm(grids[occupied], grids_true[occupied])


def occupancy_iou(
    grids: Float[Tensor, "*batch"], grids_true: Float[Tensor, "*batch"], clip_m: float, border_m: float | None = None
) -> Float[Tensor, ""]:
    """Intersection over union of occupied cells over all grids together (1 if no cell is occupied).

    A reconstructed cell is occupied below `border_m`; default: `clip_m`.
    """
    limit = clip_m * (1 - _ROUNDING)
    occupied, occupied_true = grids < (limit if border_m is None else border_m), grids_true < limit
    union = (occupied | occupied_true).sum()
    return torch.where(union > 0, (occupied & occupied_true).sum() / union.clamp_min(1), 1.0)
