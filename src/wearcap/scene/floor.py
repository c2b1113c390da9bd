"""Height of the floor beneath the wearer, from points of the surroundings or from the head alone."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_matrix
from torch import Tensor

from wearcap.errors import WearcapError

EYE_HEIGHT_OF_STATURE = 0.936
"""Eyes above the floor as a share of stature, standing (Drillis and Contini 1966)."""

_CELL_M, _BIN_M = 0.2, 0.02
_RADIUS_M = 0.8
"""Points no further than this from the head, seen from above, speak about the floor beneath it."""
_NEAR_M = 0.25
"""Standard deviation of their weight over that distance: on stairs the nearest step counts."""
_KEY_STEP_M = 0.15
"""The head's path is examined once in so many metres."""
_FAINT = 0.3
"""Layers of fewer points per bin than this say little."""
_CLEARANCE_M = (0.3, 2.3)
"""The head is never nearer to the floor, nor further from it."""
_CHANGE_COST = 20.0
"""Cost of a metre up or down, in the units of `_evidence` (ours, as all weights here)."""


@dataclass(frozen=True)
class FloorEstimate:
    """Floor height beneath each head position."""

    height: Float[Tensor, "time"]
    """Metres, in the world's z."""
    confidence: Float[Tensor, "time"]
    """0 (nothing seen there: carried over from elsewhere) … 1 (hundreds of points lie on it)."""


def estimate_floor(
    points_world: Float[Tensor, "point 3"],
    t_world_head: Float[Tensor, "time 3"],
    standing_m: float | None = None,
) -> FloorEstimate:
    """Floor beneath a moving head: at each place the lowest strong horizontal layer, changing no more than it must.

    The path is cut into steps of 0.15 m; each step votes for heights with the points within 0.8 m, and dynamic
    programming picks the sequence of heights with the best votes and the least change, so stairs are followed
    (within two steps, a step low on average) and tables are not. `standing_m` is the head's height above the floor
    when standing, where it is known.
    Raises WearcapError without a head path or when no point lies below it.
    """
    head = t_world_head.detach().cpu().double().numpy()
    points = points_world.detach().cpu().numpy()
    if not len(head) or not np.isfinite(head).all():
        raise WearcapError("no head path, or one with NaN", expected="finite head positions")
    keys, key_of_frame = _key_positions(head)
    bottom = keys[:, 2].min() - _CLEARANCE_M[1]
    bins = int(np.ceil((keys[:, 2].max() - _CLEARANCE_M[0] - bottom) / _BIN_M)) + 1
    votes = _votes(points, keys, bottom, bins)
    if not votes.any():
        raise WearcapError("no points beneath the head's path", expected="a cloud in the head's world, z up",
                           fix="Give the wearer's stature instead: floor_from_head.")  # fmt: skip
    heights = bottom + (np.arange(bins) + 0.5) * _BIN_M
    cost = _evidence(votes) + _posture_cost(keys[:, 2:] - heights, standing_m)
    chosen = _cheapest_path(cost, _CHANGE_COST * _BIN_M)
    support = gaussian_filter1d(votes, 1.5, axis=1)[np.arange(len(keys)), chosen] * (1.5 * np.sqrt(2 * np.pi))
    refined = _centre_of_layer(votes, chosen, heights)
    return FloorEstimate(
        torch.tensor(refined[key_of_frame], dtype=torch.float32),
        torch.tensor((support / (support + 10))[key_of_frame], dtype=torch.float32),
    )


def floor_from_head(t_world_eyes: Float[Tensor, "time 3"], stature_m: float) -> FloorEstimate:
    """One floor for the whole path, from the height of the eyes while upright (their 90th percentile).

    Right where the wearer stands or walks for a tenth of the time and stays on one storey; confidence 0.2.
    Raises WearcapError for a stature that no person has.
    """
    if not 0.5 < stature_m < 2.6:
        raise WearcapError(f"stature {stature_m} m", expected="metres, between 0.5 and 2.6")
    upright = torch.quantile(t_world_eyes[:, 2].double(), 0.9).item()
    height = upright - EYE_HEIGHT_OF_STATURE * stature_m
    return FloorEstimate(torch.full((len(t_world_eyes),), height), torch.full((len(t_world_eyes),), 0.2))


def _key_positions(head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One position per `_KEY_STEP_M` of path, and for each frame the key it belongs to."""
    arc = np.concatenate([[0.0], np.linalg.norm(np.diff(head, axis=0), axis=1).cumsum()])
    _, first, key_of_frame = np.unique(np.floor(arc / _KEY_STEP_M), return_index=True, return_inverse=True)
    return head[first], key_of_frame


def _votes(points: np.ndarray, keys: np.ndarray, bottom: float, bins: int) -> np.ndarray:
    """Points near each key by height: (key, bin) weighted counts. Points are put into columns of 0.2 m once."""
    reach = int(np.ceil(_RADIUS_M / _CELL_M))
    grid = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    disc = grid[np.linalg.norm(grid * _CELL_M, axis=1) <= _RADIUS_M]
    near = np.floor(keys[:, None, :2] / _CELL_M).astype(np.int64) + disc
    columns, column_of = np.unique(_cell_key(near).reshape(-1), return_inverse=True)
    level = np.floor((points[:, 2] - bottom) / _BIN_M)
    usable = np.isfinite(points).all(1) & (level >= 0) & (level < bins)
    key = _cell_key(np.floor(points[usable, :2] / _CELL_M).astype(np.int64))
    place = np.searchsorted(columns, key).clip(max=len(columns) - 1)
    inside = columns[place] == key
    flat = place[inside] * bins + level[usable][inside].astype(np.int64)
    counts = np.bincount(flat, minlength=len(columns) * bins).reshape(len(columns), bins)
    rows = np.repeat(np.arange(len(keys)), len(disc))
    weight = np.tile(np.exp(-0.5 * (np.linalg.norm(disc * _CELL_M, axis=1) / _NEAR_M) ** 2), len(keys))
    gather = csr_matrix((weight, (rows, column_of.reshape(-1))), shape=(len(keys), len(columns)))
    return gather @ counts


def _cell_key(cell: np.ndarray) -> np.ndarray:
    return cell[..., 0] * (1 << 32) + cell[..., 1]


def _evidence(votes: np.ndarray) -> np.ndarray:
    """Cost of each height: how weak its layer is beside the strongest there, and how much lies beneath it."""
    layer = gaussian_filter1d(votes, 1.5, axis=1)
    strength = (layer + _FAINT) / (layer.max(1, keepdims=True) + _FAINT)
    margin = int(0.08 / _BIN_M)
    beneath = np.pad(votes.cumsum(1), ((0, 0), (margin, 0)))[:, : votes.shape[1]]
    share = beneath / np.maximum(votes.sum(1, keepdims=True), 1)  # a lone point beneath is no evidence
    return -np.log(strength) + 6.0 * share


def _posture_cost(clearance: np.ndarray, standing_m: float | None) -> np.ndarray:
    """Cost of the head's height above a floor: free from sitting to standing, dear above, impossible far off."""
    tallest = 1.9 if standing_m is None else standing_m + 0.08
    cost = 3.0 * np.maximum(1.1 - clearance, 0) + 20.0 * np.maximum(clearance - tallest, 0)
    return np.where((clearance < _CLEARANCE_M[0]) | (clearance > _CLEARANCE_M[1]), 1e3, cost)


def _cheapest_path(cost: np.ndarray, change_cost: float) -> np.ndarray:
    """Bin per key with the least sum of costs plus `change_cost` per bin of change (Viterbi, min-plus by L1)."""
    ramp = change_cost * np.arange(cost.shape[1])
    best = [cost[0]]
    for row in cost[1:]:
        from_below = np.minimum.accumulate(best[-1] - ramp) + ramp
        from_above = np.minimum.accumulate((best[-1] + ramp)[::-1])[::-1] - ramp
        best.append(np.minimum(from_below, from_above) + row)
    chosen = [int(best[-1].argmin())]
    for row in best[-2::-1]:
        chosen.append(int((row + np.abs(ramp - ramp[chosen[-1]])).argmin()))
    return np.array(chosen[::-1])


def _centre_of_layer(votes: np.ndarray, chosen: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Mean height of the points within two bins of the chosen one (the bin's middle where there are none)."""
    around = chosen[:, None] + np.arange(-2, 3)
    exists = (around >= 0) & (around < votes.shape[1])
    around = around.clip(0, votes.shape[1] - 1)
    weight = np.take_along_axis(votes, around, 1) * exists
    total = weight.sum(1)
    mean = (weight * heights[around]).sum(1) / np.where(total > 0, total, 1)
    return np.where(total > 0, mean, heights[chosen])
