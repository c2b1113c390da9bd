"""The floor that the wearer stands on, followed by where the feet touch it (MocapEvery, appendix D.2)."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor


@runtime_checkable
class FloorFollower(Protocol):
    """Follows the floor through a capture, some frames after the other: where they are likely to be, then what their
    feet say."""

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        """Take in points of the surroundings (m)."""
        ...

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        """Height (m) of the floor beneath the next frames, before their feet are known."""
        ...

    def follow(
        self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]
    ) -> None:
        """Take in the same frames' probability of contact, and where their foot joints are (m)."""
        ...


class _Cloud:
    """Points to be asked for by place; more may come."""

    def __init__(self):
        self._trees: list[KDTree] = []

    def add(self, points_world: Float[Tensor, "point 3"]) -> None:
        points = points_world.detach().cpu().double().numpy()
        points = points[np.isfinite(points).all(1)]
        # Few trees of rising size: each is built anew only when as many points have come as it holds.
        while self._trees and self._trees[-1].n <= len(points):
            points = np.concatenate([self._trees.pop().data, points])
        if len(points):
            self._trees.append(KDTree(points))

    @property
    def empty(self) -> bool:
        return not self._trees

    def within(self, place: np.ndarray, radius_m: float) -> np.ndarray:
        """Heights (m) of all points that near to a place."""
        found = [tree.data[tree.query_ball_point(place, radius_m), 2] for tree in self._trees]
        return np.concatenate(found) if found else np.zeros(0)

    def nearest(self, places: np.ndarray, radius_m: float, count: int) -> np.ndarray:
        """Heights (m) of the nearest points to each place, NaN for fewer than `count` of each tree within the radius."""
        columns = []
        for tree in self._trees:
            number = tree.query(places, count, distance_upper_bound=radius_m)[1].reshape(len(places), -1)
            columns.append(np.append(tree.data[:, 2], np.nan)[number])
        return np.concatenate(columns, 1) if columns else np.full((len(places), 1), np.nan)


@dataclass(frozen=True)
class UpdateSettings:
    """The document's numbers; times in frames of 30 in a second."""

    contact: float = 0.5
    radius_m: float = 0.15
    min_points: int = 10
    min_change_m: float = 0.1
    settled: int = 5
    """Both feet in contact for so many frames before and after a frame: nothing changes there."""
    min_frames: int = 25
    """Between updates."""


class FloorUpdate:
    """D.2 as it stands. The second rule looks `settled` frames ahead, so a stream's floor lags by as many."""

    def __init__(self, initial_m: float, settings: UpdateSettings | None = None):
        self._settings, self._height = settings or UpdateSettings(), initial_m
        self._cloud = _Cloud()
        self._since = self._settings.min_frames
        keep = 2 * self._settings.settled
        self._contact = np.zeros((keep, 2), bool)
        self._feet = np.full((keep, 2, 3), np.nan)
        self._latest: np.ndarray | None = None
        """Foot of the latest contact."""

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        self._cloud.add(points_world)

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        return torch.full((len(t_world_head),), self._height)

    def follow(
        self,
        contact_prob: Float[Tensor, "time foot"],
        t_world_foot: Float[Tensor, "time foot 3"],
    ) -> None:
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
    """Ours; times in frames of 30 in a second."""

    contact: float = 0.5
    radius_m: float = 0.15
    """Points so near a standing foot, seen from above …"""
    reach_m: float = 0.12
    """… and no further above or below its sole are the floor's."""
    points: int = 12
    """The nearest so many are looked at."""
    min_points: int = 4
    gain: float = 0.05
    """Share of what the floor is off that each frame of full contact takes away, by the soles' word …"""
    gain_points: float = 0.1
    """… and by that of points beneath them."""
    walking_m_s: tuple[float, float] = (0.1, 0.3)
    """From the first speed of the head on, and wholly from the second, its rising and falling is the floor's."""
    level: float = 0.15
    trend: float = 0.01
    """Shares of a frame's surprise that go into the head's smoothed height, and into how fast it rises: steps and nods
    are no floors."""


class FloorFollow:
    """The floor goes up and down with the head of one who walks, and is drawn to where feet stand (ours, after D.2).

    Without a threshold slopes are followed, too; and on stairs, where D.2 waits for the next foot, the head already
    says how far up one is. Feet, or the points beneath them, correct what the head gets wrong.
    """

    def __init__(self, initial_m: float, sole_m: float, fps: float, settings: FollowSettings | None = None):
        """`sole_m`: height of the foot joint above the floor when the foot is flat."""
        self._settings, self._sole, self._fps = settings or FollowSettings(), sole_m, fps
        self._cloud = _Cloud()
        self._floors = np.array([initial_m])
        """Of the frames that were looked ahead at last."""
        self._head: np.ndarray | None = None
        self._velocity, self._level, self._trend = np.zeros(2), 0.0, 0.0

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        self._cloud.add(points_world)

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        risen = [self._risen(head) for head in t_world_head.detach().cpu().double().numpy()]
        self._floors = self._floors[-1] + np.cumsum(risen)
        return torch.from_numpy(self._floors).float()

    def follow(
        self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]
    ) -> None:
        settings, wrong = self._settings, 0.0
        weight = (contact_prob.detach().cpu().numpy() - settings.contact).clip(0) / (1 - settings.contact)
        reported, seen = self._below(t_world_foot.detach().cpu().double().numpy())
        weight = weight * np.where(seen, settings.gain_points, settings.gain)
        total = weight.sum(1)
        target = (weight * reported).sum(1) / np.where(total > 0, total, 1)
        share = weight.max(1)
        for frame in np.flatnonzero(total):
            wrong += share[frame] * (target[frame] - self._floors[frame] - wrong)
        self._floors = self._floors + wrong

    def _risen(self, head: np.ndarray) -> float:
        """By how much the floor rises within a frame, as the head's smoothed path says (Holt's linear trend)."""
        settings = self._settings
        if self._head is None:
            self._head, self._level = head, float(head[2])
        velocity = (head[:2] - self._head[:2]) * self._fps
        self._velocity += settings.level * (velocity - self._velocity)
        self._head = head
        before, surprise = self._level, float(head[2]) - self._level - self._trend
        self._level += self._trend + settings.level * surprise
        self._trend += settings.trend * surprise
        low, high = settings.walking_m_s
        walking = float(np.clip((np.hypot(*self._velocity) - low) / (high - low), 0, 1))
        return walking * (self._level - before)

    def _below(self, feet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height (m) of the floor beneath feet "time foot 3", of the points there, else of the soles; and which it is."""
        settings, soles = self._settings, feet[..., 2] - self._sole
        if self._cloud.empty:
            return soles, np.zeros(soles.shape, bool)
        places = np.concatenate([feet[..., :2], soles[..., None]], -1).reshape(-1, 3)
        reach = float(np.hypot(settings.radius_m, settings.reach_m))
        heights = self._cloud.nearest(places, reach, settings.points)
        heights[np.abs(heights - places[:, 2:]) > settings.reach_m] = np.nan
        few = np.isfinite(heights).sum(1, keepdims=True) < settings.min_points
        heights = np.where(few, places[:, 2:], heights)
        return np.nanmedian(heights, 1).reshape(soles.shape), ~few.reshape(soles.shape)


class FloorFixed:
    """The floor where it was (the document's ablation), or where it is given."""

    def __init__(self, initial_m: float):
        self.height = initial_m

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        """Nothing changes."""

    def ahead(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        return torch.full((len(t_world_head),), self.height)

    def follow(
        self, contact_prob: Float[Tensor, "time foot"], t_world_foot: Float[Tensor, "time foot 3"]
    ) -> None:
        """Nothing changes."""
