"""Height of the floor below the wearer, from points of the surroundings."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_matrix
from torch import Tensor

from wearcap.errors import WearcapError

_BIN_M = 0.02


@dataclass(frozen=True)
class _Reach:
    """Points within a horizontal radius of the head vote for the floor height, with Gaussian weights."""

    cell_m: float
    radius_m: float
    sigma_m: float


_NEAR = _Reach(0.2, 0.8, 0.25)
"""Narrow support, which resolves single stairs."""
_WIDE = _Reach(0.4, 2.4, 1.0)
"""Wide support, for places with few points nearby."""
_ENOUGH = 30.0
"""Weighted number of near points above which the wide support hardly counts."""
_KEY_STEP_M = 0.15
"""Length of the path segments (m) that get one floor height each."""
_FAINT = 0.1
"""Weighted points per bin below which a layer is weak evidence."""
_CLEARANCE_M = (0.3, 2.3)
"""Smallest and largest height of the head above the floor."""
_CHANGE_COST = 20.0
"""Cost of a metre up or down, in the units of the evidence (ours, as all weights here)."""


@dataclass(frozen=True)
class FloorEstimate:
    """Floor height below each head position."""

    height: Float[Tensor, "time"]
    """Floor height (m), along the world's z."""
    confidence: Float[Tensor, "time"]
    """0 (no points there, taken over from neighbours) … 1 (hundreds of points on the floor)."""


def estimate_floor(
    points_world: Float[Tensor, "point 3"], t_world_head: Float[Tensor, "time 3"], standing_m: float | None = None
) -> FloorEstimate:
    """Floor below a moving head: everywhere the lowest strong horizontal layer, with as little change as possible.

    The path is cut into steps of 0.15 m; each step votes for heights with the points within 0.8 m (2.4 m
    where they are few), and dynamic programming picks the sequence of heights with the best votes and the least
    change, so stairs are followed (within a step) and tables are not. `standing_m` is the
    head's height above the floor when upright; by default it is read off a first pass.
    Raises WearcapError without a head path or when no point lies below it.
    """
    head = t_world_head.detach().cpu().double().numpy()
    points = points_world.detach().cpu().numpy()
    if not len(head) or not np.isfinite(head).all():
        raise WearcapError("no head path, or one with NaN", expected="finite head positions")
    arc = np.concatenate([[0.0], np.linalg.norm(np.diff(head, axis=0), axis=1).cumsum()])
    _, first, key_of_frame = np.unique(np.floor(arc / _KEY_STEP_M), return_index=True, return_inverse=True)
    keys = head[first]
    bottom = keys[:, 2].min() - _CLEARANCE_M[1]
    bins = int(np.ceil((keys[:, 2].max() - _CLEARANCE_M[0] - bottom) / _BIN_M)) + 1
    near, wide = (_votes(points, keys, bottom, bins, reach) for reach in (_NEAR, _WIDE))
    votes = near + wide * (1 - near.sum(1, keepdims=True) / _ENOUGH).clip(0.02, 1)
    if not votes.any():
        raise WearcapError(
            "no points below the head's path",
            expected="a cloud in the head's world, z up",
            fix="Check that the cloud and the head path share one world, and that the cloud shows the floor.",
        )
    heights = bottom + (np.arange(bins) + 0.5) * _BIN_M
    clearance = keys[:, 2:] - heights
    # Cost of each height: how weak its layer is beside the strongest there, and the share of points below it.
    layer = gaussian_filter1d(votes, 1.5, axis=1)
    strength = (layer + _FAINT) / (layer.max(1, keepdims=True) + _FAINT)
    margin = int(0.08 / _BIN_M)
    below = np.pad(votes.cumsum(1), ((0, 0), (margin, 0)))[:, :bins]
    share = below / np.maximum(votes.sum(1, keepdims=True), 1)  # a single point below is no evidence
    evidence = -np.log(strength) + 6.0 * share.clip(max=0.4)
    if standing_m is None:
        first = _cheapest_path(evidence + _posture_cost(clearance, 1.9, 20.0), _CHANGE_COST * _BIN_M)
        standing_m = _usual_clearance(np.take_along_axis(clearance, first[:, None], 1)[:, 0])
    # With the wearer's height, a ceiling below an upper floor is no longer mistaken for that floor.
    chosen = _cheapest_path(evidence + _posture_cost(clearance, standing_m + 0.03, 40.0), _CHANGE_COST * _BIN_M)
    support = layer[np.arange(len(keys)), chosen] * (1.5 * np.sqrt(2 * np.pi))
    refined = _centre_of_layer(votes, chosen, heights)
    return FloorEstimate(
        torch.tensor(refined[key_of_frame], dtype=torch.float32),
        torch.tensor((support / (support + 10))[key_of_frame], dtype=torch.float32),
    )


def _votes(points: np.ndarray, keys: np.ndarray, bottom: float, bins: int, reach: _Reach) -> np.ndarray:
    """Weighted point counts (key, bin) by height near each key, from a precomputed histogram of floor cells."""
    cells = int(np.ceil(reach.radius_m / reach.cell_m))
    grid = np.stack(np.meshgrid(*[np.arange(-cells, cells + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    distance = np.linalg.norm(grid * reach.cell_m, axis=1)
    disc, distance = grid[distance <= reach.radius_m], distance[distance <= reach.radius_m]
    near = np.floor(keys[:, None, :2] / reach.cell_m).astype(np.int64) + disc
    columns, column_of = np.unique(_cell_key(near).reshape(-1), return_inverse=True)
    level = np.floor((points[:, 2] - bottom) / _BIN_M)
    usable = np.isfinite(points).all(1) & (level >= 0) & (level < bins)
    key = _cell_key(np.floor(points[usable, :2] / reach.cell_m).astype(np.int64))
    place = np.searchsorted(columns, key).clip(max=len(columns) - 1)
    inside = columns[place] == key
    flat = place[inside] * bins + level[usable][inside].astype(np.int64)
    counts = np.bincount(flat, minlength=len(columns) * bins).reshape(len(columns), bins)
    rows = np.repeat(np.arange(len(keys)), len(disc))
    weight = np.tile(np.exp(-0.5 * (distance / reach.sigma_m) ** 2), len(keys))
    gather = csr_matrix((weight, (rows, column_of.reshape(-1))), shape=(len(keys), len(columns)))
    return gather @ counts


def _cell_key(cell: np.ndarray) -> np.ndarray:
    return cell[..., 0] * (1 << 32) + cell[..., 1]


def _posture_cost(clearance: np.ndarray, tallest: float, slope: float) -> np.ndarray:
    """Cost of the head's height above a floor: free from sitting to `tallest`, rising by `slope` per metre above."""
    cost = 3.0 * np.maximum(1.1 - clearance, 0) + slope * np.maximum(clearance - tallest, 0)
    return np.where((clearance < _CLEARANCE_M[0]) | (clearance > _CLEARANCE_M[1]), 1e3, cost)


def _usual_clearance(clearance: np.ndarray) -> float:
    """Height of the head above the floor while walking: the lowest of its common values near the commonest."""
    counts = gaussian_filter1d(np.histogram(clearance, np.arange(0.0, 2.6, 0.01))[0].astype(float), 2.0)
    peak = int(counts.argmax())
    near = np.arange(max(peak - 25, 0), peak + 1)
    inner = counts[near]
    summit = (inner >= np.r_[0.0, inner[:-1]]) & (inner >= np.r_[inner[1:], 0.0]) & (inner > 0.3 * counts[peak])
    return float(0.01 * (near[summit][0] + 0.5))


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
