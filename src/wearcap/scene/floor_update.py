"""Floor height below the wearer, updated from foot contacts and points (MocapEvery, appendix D.2)."""

from dataclasses import dataclass
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


@dataclass(frozen=True)
class UpdateSettings:
    """Parameters of D.2 with the paper's values; durations in frames at 30 Hz."""

    contact: float = 0.5
    """Contact probability above which a foot is in contact."""
    radius_m: float = 0.15
    """Radius around the foot within which points are averaged."""
    min_points: int = 10
    """Fewest points for an average; with fewer the foot's own height is used."""
    min_change_m: float = 0.1
    """Smallest change of the floor height."""
    settled: int = 5
    """No update at frames where both feet are in contact for this many frames before and after."""
    min_frames: int = 25
    """Fewest frames between updates."""


class FloorUpdate:
    """Floor update of D.2. The `settled` rule looks that many frames ahead, so the floor height lags by as many."""

    def __init__(self, initial_m: float, settings: UpdateSettings | None = None):
        self._settings, self._height = settings or UpdateSettings(), initial_m
        self._cloud = _Cloud()
        self._since = self._settings.min_frames
        keep = 2 * self._settings.settled
        self._contact = np.zeros((keep, 2), bool)
        self._feet = np.full((keep, 2, 3), np.nan)
        self._latest: np.ndarray | None = None
        """Position (m) of the foot that was in contact last."""

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        self._cloud.add(points_world)

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        return torch.full((len(t_world_head),), self._height)

    def follow(self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]) -> None:
        settled = self._settings.settled
        prob = contact_prob.detach().cpu().numpy()
        contact = np.concatenate([self._contact, prob > self._settings.contact])
        feet = np.concatenate([self._feet, t_world_foot.detach().cpu().double().numpy()])
        standing = contact.all(1)
        still = np.lib.stride_tricks.sliding_window_view(standing, 2 * settled + 1).all(1)
        best = np.concatenate([np.zeros((2 * settled, 2)), prob]).argmax(1)
        for k, frame in enumerate(range(settled, len(contact) - settled)):
            self._since += 1
            if contact[frame].any():
                self._latest = feet[frame, best[frame] if contact[frame].all() else int(contact[frame, 1])]
            if self._latest is not None and not still[k] and self._since >= self._settings.min_frames:
                self._update(self._latest)
        self._contact, self._feet = contact[-2 * settled :], feet[-2 * settled :]

    def _update(self, foot: np.ndarray) -> None:
        near = self._cloud.within(foot, self._settings.radius_m)
        height = float(near.mean()) if len(near) >= self._settings.min_points else float(foot[2])
        if abs(height - self._height) >= self._settings.min_change_m:
            self._height, self._since = height, 0


@dataclass(frozen=True)
class FollowSettings:
    """Parameters of `FloorFollow` (ours), for 30 Hz."""

    contact: float = 0.5
    """Contact probability above which a foot corrects the floor."""
    radius_m: float = 0.15
    """Horizontal distance to a foot within which points belong to the floor."""
    reach_m: float = 0.12
    """Vertical distance to its sole within which they do."""
    points: int = 12
    """Number of nearest points that are used."""
    min_points: int = 4
    """Fewest points within both distances; with fewer the sole's height is used."""
    gain: float = 0.05
    """Share of the floor's error that a frame of full contact corrects, measured by the sole's height."""
    gain_points: float = 0.1
    """The same, measured by points below the sole."""
    walking_m_s: tuple[float, float] = (0.1, 0.3)
    """Head speeds between which the head's rise starts to move the floor, and moves it fully."""
    level: float = 0.15
    """Smoothing factor of the head's height (Holt's method), against the ups and downs of steps and nods."""
    trend: float = 0.01
    """Smoothing factor of the head's rate of rise."""


class FloorFollow:
    """Floor that rises and falls with the walking wearer's head and is corrected by standing feet (ours, after D.2).

    There is no threshold, so it also follows slopes; on stairs the head moves the floor before the next foot is down,
    for which D.2 waits. Feet, or the points below them, correct the error of the head's estimate.
    """

    def __init__(self, initial_m: float, sole_m: float, fps: float, settings: FollowSettings | None = None):
        """`sole_m`: height of the foot joint above the floor when the foot is flat."""
        self._settings, self._sole, self._fps = settings or FollowSettings(), sole_m, fps
        self._cloud = _Cloud()
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
        settings, correction = self._settings, 0.0
        weight = (contact_prob.detach().cpu().numpy() - settings.contact).clip(0) / (1 - settings.contact)
        height, from_points = self._floor_at(t_world_foot.detach().cpu().double().numpy())
        weight = weight * np.where(from_points, settings.gain_points, settings.gain)
        total = weight.sum(1)
        target = (weight * height).sum(1) / np.where(total > 0, total, 1)
        share = weight.max(1)
        for frame in np.flatnonzero(total):
            correction += share[frame] * (target[frame] - self._floors[frame] - correction)
        self._floors = self._floors + correction

    def _rise(self, head: np.ndarray) -> float:
        """Rise of the floor (m) within a frame, from the head's smoothed height (Holt's linear trend)."""
        settings = self._settings
        if self._head is None:
            self._head, self._level = head, float(head[2])
        velocity = (head[:2] - self._head[:2]) * self._fps
        self._velocity += settings.level * (velocity - self._velocity)
        self._head = head
        before, innovation = self._level, float(head[2]) - self._level - self._trend
        self._level += self._trend + settings.level * innovation
        self._trend += settings.trend * innovation
        low, high = settings.walking_m_s
        walking = float(np.clip((np.hypot(*self._velocity) - low) / (high - low), 0, 1))
        return walking * (self._level - before)

    def _floor_at(self, feet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Floor height (m) at feet "time foot 3", from points where there are enough, else from the soles; and whether
        it is from points."""
        settings, soles = self._settings, feet[..., 2] - self._sole
        if self._cloud.empty:
            return soles, np.zeros(soles.shape, bool)
        positions = np.concatenate([feet[..., :2], soles[..., None]], -1).reshape(-1, 3)
        reach = float(np.hypot(settings.radius_m, settings.reach_m))
        heights = self._cloud.nearest(positions, reach, settings.points)
        heights[np.abs(heights - positions[:, 2:]) > settings.reach_m] = np.nan
        few = np.isfinite(heights).sum(1, keepdims=True) < settings.min_points
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
