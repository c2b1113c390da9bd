"""Floor height below the wearer, updated from foot contacts and points (MocapEvery, appendix D.2)."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor


@runtime_checkable
class FloorFollower(Protocol):
    """Estimates the floor height during a capture. For each block of frames `ahead` predicts the height from the head,
    then `follow` corrects it from the estimated feet."""

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        """Take in points of the surroundings (m)."""
        ...

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        """Predicted floor height (m) of the next frames, before their feet are estimated."""
        ...

    def follow(self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]) -> None:
        """Take in the same frames' contact probabilities and foot joint positions (m)."""
        ...


class _Cloud:
    """Incremental spatial index of points."""

    def __init__(self):
        self._trees: list[KDTree] = []
        self._points: list[np.ndarray] = []
        """Points of each tree (m)."""

    transient = ("_trees",)

    def restored(self) -> None:
        """Rebuild the trees after loading."""
        self._trees = [KDTree(points) for points in self._points]

    def add(self, points_world: Float[Tensor, "point 3"]) -> None:
        points = points_world.detach().cpu().double().numpy()
        points = points[np.isfinite(points).all(1)]
        # Few trees of increasing size: each is rebuilt only after as many new points as it holds.
        while self._trees and self._trees[-1].n <= len(points):
            points = np.concatenate([self._trees.pop().data, points])
        if len(points):
            self._trees.append(KDTree(points))
        self._points = [np.asarray(tree.data) for tree in self._trees]

    @property
    def empty(self) -> bool:
        return not self._trees

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
    GAIN, GAIN_POINTS = 0.05, 0.1
    """Share of the floor's error that a frame of full contact corrects, measured by the sole's height or by points."""
    WALKING_M_S = (0.1, 0.3)
    """Head speeds between which the head's rise starts to move the floor, and moves it fully."""
    LEVEL, TREND = 0.15, 0.01
    """Smoothing factors of the head's height (Holt's method; against steps and nods) and of its rate of rise."""

    def __init__(self, initial_m: float, sole_m: float, fps: float):
        """`sole_m`: height of the foot joint above the floor when the foot is flat."""
        self._sole, self._fps, self._cloud = sole_m, fps, _Cloud()
        self._floors = np.array([initial_m])
        """Floor heights (m) of the latest block of frames."""
        self._head: np.ndarray | None = None
        self._velocity, self._level, self._trend = np.zeros(2), 0.0, 0.0

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        self._cloud.add(points_world)

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        rise = [self._rise(head) for head in t_world_head.detach().cpu().double().numpy()]
        self._floors = self._floors[-1] + np.cumsum(rise)
        return torch.from_numpy(self._floors).float()

    def follow(self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]) -> None:
        correction = 0.0
        weight = (contact_prob.detach().cpu().numpy() - self.CONTACT).clip(0) / (1 - self.CONTACT)
        height, from_points = self._floor_at(t_world_foot.detach().cpu().double().numpy())
        weight = weight * np.where(from_points, self.GAIN_POINTS, self.GAIN)
        total = weight.sum(1)
        target = (weight * height).sum(1) / np.where(total > 0, total, 1)
        share = weight.max(1)
        for frame in np.flatnonzero(total):
            correction += share[frame] * (target[frame] - self._floors[frame] - correction)
        self._floors = self._floors + correction

    def _rise(self, head: np.ndarray) -> float:
        """Rise of the floor (m) within a frame, from the head's smoothed height (Holt's linear trend)."""
        if self._head is None:
            self._head, self._level = head, float(head[2])
        velocity = (head[:2] - self._head[:2]) * self._fps
        self._velocity += self.LEVEL * (velocity - self._velocity)
        self._head = head
        before, innovation = self._level, float(head[2]) - self._level - self._trend
        self._level += self._trend + self.LEVEL * innovation
        self._trend += self.TREND * innovation
        low, high = self.WALKING_M_S
        walking = float(np.clip((np.hypot(*self._velocity) - low) / (high - low), 0, 1))
        return walking * (self._level - before)

    def _floor_at(self, feet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Floor height (m) at feet "time foot 3", from points where there are enough, else from the soles; and whether
        it is from points."""
        soles = feet[..., 2] - self._sole
        if self._cloud.empty:
            return soles, np.zeros(soles.shape, bool)
        positions = np.concatenate([feet[..., :2], soles[..., None]], -1).reshape(-1, 3)
        heights = self._cloud.nearest(positions, float(np.hypot(self.RADIUS_M, self.REACH_M)), self.POINTS)
        heights[np.abs(heights - positions[:, 2:]) > self.REACH_M] = np.nan
        few = np.isfinite(heights).sum(1, keepdims=True) < self.MIN_POINTS
        heights = np.where(few, positions[:, 2:], heights)
        return np.nanmedian(heights, 1).reshape(soles.shape), ~few.reshape(soles.shape)


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
