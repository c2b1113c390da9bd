"""Scores of binary detection (thesis Table 5.3), and errors of reconstructed voxel grids.

Cells of a grid are truncated distances; one with a distance below `clip_m` is occupied.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.metrics.position import CM_PER_M

_ROUNDING = 1e-3
"""Margin below `clip_m`, as a share of it, for the rounding of half-precision files."""


class _DetectionScores(NamedTuple):
    """Scores in 0…1; NaN where undefined, such as recall without a positive sample."""

    average_precision: float
    precision: float
    recall: float
    accuracy: float
    calibration_error: float


def detection_scores(
    prob: Float[Tensor, "sample"], truth: Bool[Tensor, "sample"], threshold: float = 0.5
) -> _DetectionScores:
    """Scores of one detector; precision, recall and accuracy at `threshold`."""
    found = prob > threshold
    hits = float((found & truth).sum())
    return _DetectionScores(
        average_precision(prob, truth),
        _share(hits, float(found.sum())),
        _share(hits, float(truth.sum())),
        _share(float((found == truth).sum()), len(truth)),
        calibration_error(prob, truth),
    )


def mean_detection_scores(
    prob: Float[Tensor, "sample hand"], truth: Bool[Tensor, "sample hand"], threshold: float = 0.5
) -> _DetectionScores:
    """Mean of the hands' scores, as in the thesis; undefined scores of a hand are ignored."""
    hands = torch.tensor([detection_scores(prob[:, h], truth[:, h], threshold) for h in range(prob.shape[1])])
    return _DetectionScores(*hands.nanmean(0).tolist())


def average_precision(prob: Float[Tensor, "sample"], truth: Bool[Tensor, "sample"]) -> float:
    """Average precision Σ (R_n - R_(n-1)) P_n over falling thresholds; ties are grouped (scikit-learn's definition)."""
    order = prob.argsort(descending=True, stable=True)
    hits = truth[order].double().cumsum(0)
    if not len(hits) or not hits[-1]:
        return float("nan")
    # Thresholds follow the last of equal probabilities.
    ends = torch.cat([prob[order].diff() != 0, torch.ones(1, dtype=torch.bool, device=prob.device)])
    hits, count = hits[ends], torch.arange(1, len(order) + 1, device=prob.device)[ends]
    gained = hits.diff(prepend=hits.new_zeros(1))
    return float((gained * hits / count).sum() / hits[-1])


def calibration_error(prob: Float[Tensor, "sample"], truth: Bool[Tensor, "sample"]) -> float:
    """Expected calibration error over ten bins of equal width (Guo et al. 2017)."""
    if not len(prob):
        return float("nan")
    place = (prob * 10).long().clamp(0, 9)
    excess = torch.zeros(10, dtype=torch.float64, device=prob.device)
    excess.index_add_(0, place, prob.double() - truth.double())
    return float(excess.abs().sum() / len(prob))


def _share(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")


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
    """Intersection over union of occupied cells over all grids together (1 if no cell is occupied); a reconstructed
    cell is occupied below `border_m`; default: `clip_m`."""
    limit = clip_m * (1 - _ROUNDING)
    occupied, occupied_true = grids < (limit if border_m is None else border_m), grids_true < limit
    union = (occupied | occupied_true).sum()
    return torch.where(union > 0, (occupied & occupied_true).sum() / union.clamp_min(1), 1.0)
