"""Height of the floor below the wearer: estimated from points, and updated from foot contacts and points (MocapEvery,
appendix D.2)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree
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
class _FloorEstimate:
    """Floor height below each head position."""

    height: Float[Tensor, "time"]
    """Floor height (m), along the world's z."""
    confidence: Float[Tensor, "time"]
    """0 (no points there, taken over from neighbours) … 1 (hundreds of points on the floor)."""


def estimate_floor(
    points_world: Float[Tensor, "point 3"], t_world_head: Float[Tensor, "time 3"], standing_m: float | None = None
) -> _FloorEstimate:
    """Floor below a moving head: everywhere the lowest strong horizontal layer, with as little change as possible.

    The path is cut into steps of 0.15 m; each step votes for heights with the points within 0.8 m (2.4 m where they
    are few), and dynamic programming picks the sequence of heights with the best votes and the least change, so stairs
    are followed (within a step) and tables are not. `standing_m` is the head's height above the floor when upright; by
    default it is read off a first pass.
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
        fix = "Check that the cloud and the head path share one world, and that the cloud shows the floor."
        raise WearcapError("no points below the head's path", expected="a cloud in the head's world, z up", fix=fix)
    heights = bottom + (np.arange(bins) + 0.5) * _BIN_M
    clearance = keys[:, 2:] - heights
    # Cost of each height: how weak its layer is beside the strongest there, and the share of points below it.
    layer = gaussian_filter1d(votes, 1.5, axis=1)
    strength = (layer + _FAINT) / (layer.max(1, keepdims=True) + _FAINT)
    below = np.pad(votes.cumsum(1), ((0, 0), (int(0.08 / _BIN_M), 0)))[:, :bins]
    share = below / np.maximum(votes.sum(1, keepdims=True), 1)  # a single point below is no evidence
    evidence = -np.log(strength) + 6.0 * share.clip(max=0.4)
    if standing_m is None:
        first = _cheapest_path(evidence + _posture_cost(clearance, 1.9, 20.0), _CHANGE_COST * _BIN_M)
        # The head's height while walking: the lowest of its common values near the commonest.
        values = np.take_along_axis(clearance, first[:, None], 1)[:, 0]
        counts = gaussian_filter1d(np.histogram(values, np.arange(0.0, 2.6, 0.01))[0].astype(float), 2.0)
        peak = int(counts.argmax())
        common = np.arange(max(peak - 25, 0), peak + 1)
        inner = counts[common]
        summit = (inner >= np.r_[0.0, inner[:-1]]) & (inner >= np.r_[inner[1:], 0.0]) & (inner > 0.3 * counts[peak])
        standing_m = float(0.01 * (common[summit][0] + 0.5))
    # With the wearer's height, a ceiling below an upper floor is no longer mistaken for that floor.
    chosen = _cheapest_path(evidence + _posture_cost(clearance, standing_m + 0.03, 40.0), _CHANGE_COST * _BIN_M)
    support = layer[np.arange(len(keys)), chosen] * (1.5 * np.sqrt(2 * np.pi))
    # The mean height of the points within two bins of the chosen one (the bin's middle where there are none).
    around = chosen[:, None] + np.arange(-2, 3)
    exists, around = (around >= 0) & (around < bins), around.clip(0, bins - 1)
    weight = np.take_along_axis(votes, around, 1) * exists
    total = weight.sum(1)
    mean = (weight * heights[around]).sum(1) / np.where(total > 0, total, 1)
    refined = np.where(total > 0, mean, heights[chosen])
    return _FloorEstimate(
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


class _Cloud:
    """Incremental spatial index of points."""

    def __init__(self):
        self._trees: list[KDTree] = []

    def add(self, points_world: Float[Tensor, "point 3"]) -> None:
        points = points_world.detach().cpu().double().numpy()
        points = points[np.isfinite(points).all(1)]
        # Few trees of increasing size: each is rebuilt only after as many new points as it holds.
        while self._trees and self._trees[-1].n <= len(points):
            points = np.concatenate([self._trees.pop().data, points])
        if len(points):
            self._trees.append(KDTree(points))

    def within(self, position: np.ndarray, radius_m: float) -> np.ndarray:
        """Heights (m) of all points within a radius of a position."""
        found = [tree.data[tree.query_ball_point(position, radius_m), 2] for tree in self._trees]
        return np.concatenate(found) if found else np.zeros(0)

    def nearest(self, positions: np.ndarray, radius_m: float, count: int) -> np.ndarray:
        """Heights (m) of the `count` nearest points of each tree to each position; NaN beyond the radius."""
        columns = []
        for tree in self._trees:
            number = tree.query(positions, count, distance_upper_bound=radius_m)[1].reshape(len(positions), -1)
            columns.append(np.append(tree.data[:, 2], np.nan)[number])
        return np.concatenate(columns, 1) if columns else np.full((len(positions), 1), np.nan)


class FloorUpdate:
    """Floor update of D.2 with the paper's values; durations in frames at 30 Hz.

    The rule of `SETTLED` looks that many frames ahead, so the floor height lags by as many.
    """

    CONTACT = 0.5
    """Contact probability above which a foot is in contact."""
    RADIUS_M = 0.15
    """Radius around the foot within which points are averaged."""
    MIN_POINTS = 10
    """Fewest points for an average; with fewer the foot's own height is used."""
    MIN_CHANGE_M = 0.1
    """Smallest change of the floor height."""
    SETTLED = 5
    """No update at frames where both feet are in contact for this many frames before and after."""
    MIN_FRAMES = 25
    """Fewest frames between updates."""

    def __init__(self, initial_m: float):
        self._height, self._cloud, self._since = initial_m, _Cloud(), self.MIN_FRAMES
        self._contact = np.zeros((2 * self.SETTLED, 2), bool)
        self._feet = np.full((2 * self.SETTLED, 2, 3), np.nan)
        self._latest: np.ndarray | None = None
        """Position (m) of the foot that was in contact last."""

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        self._cloud.add(points_world)

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        return torch.full((len(t_world_head),), self._height)

    def follow(self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]) -> None:
        settled = self.SETTLED
        prob = contact_prob.detach().cpu().numpy()
        contact = np.concatenate([self._contact, prob > self.CONTACT])
        feet = np.concatenate([self._feet, t_world_foot.detach().cpu().double().numpy()])
        still = np.lib.stride_tricks.sliding_window_view(contact.all(1), 2 * settled + 1).all(1)
        best = np.concatenate([np.zeros((2 * settled, 2)), prob]).argmax(1)
        for k, frame in enumerate(range(settled, len(contact) - settled)):
            self._since += 1
            if contact[frame].any():
                self._latest = feet[frame, best[frame] if contact[frame].all() else int(contact[frame, 1])]
            if self._latest is None or still[k] or self._since < self.MIN_FRAMES:
                continue
            near = self._cloud.within(self._latest, self.RADIUS_M)
            height = float(near.mean()) if len(near) >= self.MIN_POINTS else float(self._latest[2])
            if abs(height - self._height) >= self.MIN_CHANGE_M:
                self._height, self._since = height, 0
        self._contact, self._feet = contact[-2 * settled :], feet[-2 * settled :]


class FloorFollow:
    """Floor that rises and falls with the walking wearer's head and is corrected by standing feet (ours, after D.2).

    There is no threshold, so it also follows slopes; on stairs the head moves the floor before the next foot is down,
    for which D.2 waits. Feet, or the points below them, correct the error of the head's estimate. Values for 30 Hz.
    """

    CONTACT = 0.5
    """Contact probability above which a foot corrects the floor."""
    RADIUS_M, REACH_M = 0.15, 0.12
    """Horizontal distance to a foot, and vertical distance to its sole, within which points belong to the floor."""
    POINTS, MIN_POINTS = 12, 4
    """Number of nearest points that are used, and fewest of them within both distances (else the sole is used)."""
    GAIN = 0.1
    """Share of the floor's error that a frame of full contact corrects, measured by points or by the sole's height."""
    WALKING_M_S = (0.3, 0.5)
    """Speeds of the head, over `STEP_S`, between which its rise starts to move the floor, and moves it fully."""
    STEP_S = 2.0
    """Time (s) over which the head's way counts: who squats or bends comes back, who climbs does not."""
    STEEPEST = 1.0
    """Largest rise of the floor per horizontal distance: stairs have 0.8."""
    LEVEL, TREND = 0.15, 0.01
    """Smoothing factors of the head's height (Holt's method; against steps and nods) and of its rate of rise."""

    def __init__(self, initial_m: float, sole_m: float, fps: float):
        """`sole_m`: height of the foot joint above the floor when the foot is flat."""
        self._sole, self._fps, self._cloud = sole_m, fps, _Cloud()
        self._floors = np.array([initial_m])
        """Floor heights (m) of the latest block of frames."""
        self._heads = np.zeros((0, 3))
        """Head positions (m) of the latest frames, over `STEP_S`."""
        self._level, self._trend = 0.0, 0.0

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        self._cloud.add(points_world)

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        # The rise of the floor (m) within a frame follows from the head's smoothed height (Holt's linear trend).
        heads, (low, high) = t_world_head.detach().cpu().double().numpy(), self.WALKING_M_S
        if not len(self._heads):
            self._heads, self._level = heads[:1], float(heads[0, 2])
        rise = []
        for height in heads[:, 2].tolist():
            before, innovation = self._level, height - self._level - self._trend
            self._level += self._trend + self.LEVEL * innovation
            self._trend += self.TREND * innovation
            rise.append(self._level - before)
        known, span = len(self._heads), round(self.STEP_S * self._fps)
        path = np.concatenate([self._heads, heads])
        start = np.maximum(np.arange(known, len(path)) - span, 0)
        speed = np.linalg.norm(path[known:, :2] - path[start, :2], axis=1) / self.STEP_S
        self._heads = path[-span:]
        steepest = self.STEEPEST * speed / self._fps
        rise = np.clip((speed - low) / (high - low), 0, 1) * np.clip(rise, -steepest, steepest)
        self._floors = self._floors[-1] + np.cumsum(rise)
        return torch.from_numpy(self._floors).float()

    def follow(self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]) -> None:
        correction = 0.0
        weight = (contact_prob.detach().cpu().numpy() - self.CONTACT).clip(0) / (1 - self.CONTACT)
        # Floor height (m) at the feet, from points where there are enough, else from the soles.
        feet = t_world_foot.detach().cpu().double().numpy()
        positions = np.concatenate([feet[..., :2], feet[..., 2:] - self._sole], -1).reshape(-1, 3)
        heights = self._cloud.nearest(positions, float(np.hypot(self.RADIUS_M, self.REACH_M)), self.POINTS)
        heights[np.abs(heights - positions[:, 2:]) > self.REACH_M] = np.nan
        few = np.isfinite(heights).sum(1, keepdims=True) < self.MIN_POINTS
        heights = np.where(few, positions[:, 2:], heights)
        height = np.nanmedian(heights, 1).reshape(feet.shape[:-1])
        weight = self.GAIN * weight
        total = weight.sum(1)
        target = (weight * height).sum(1) / np.where(total > 0, total, 1)
        share = weight.max(1)
        for frame in np.flatnonzero(total):
            correction += share[frame] * (target[frame] - self._floors[frame] - correction)
        self._floors = self._floors + correction


class FloorFixed:
    """Constant floor height (the paper's ablation), or one that the caller sets."""

    def __init__(self, initial_m: float):
        self.height = initial_m

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        """Nothing changes."""

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        return torch.full((len(t_world_head),), self.height)

    def follow(self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]) -> None:
        """Nothing changes."""


FloorFollower = FloorUpdate | FloorFollow | FloorFixed
"""Estimates the floor height during a capture.

`see` takes in points of the surroundings (m). For each block of frames `ahead` predicts the floor heights (m) from the
head, before the feet are estimated; then `follow` corrects them from the same frames' contact probabilities and foot
joint positions (m)."""
