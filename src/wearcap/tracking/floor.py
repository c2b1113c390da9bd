"""The floor beneath the wearer, as sensed: from points of the surroundings, or from the head's path alone."""

from collections import defaultdict, deque
from contextlib import suppress

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.ndimage import percentile_filter
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import PointCloud
from wearcap.scene.floor import estimate_floor

MIN_POINTS = 500
"""Fewer points than this say nothing about a floor."""
UPRIGHT_WITHIN_S = 30.0
"""Someone stands or walks upright for a tenth of any such stretch."""
_LOOK_EVERY_S = 0.25
LOOK_FRAMES = 10
"""A tracked floor is looked at once in so many frames."""
RECENT_S = 6.0
"""Stretch of the path that a tracked floor is found for."""
_STOREYS_M = 30.0
"""A path does not rise by so much in `RECENT_S`: what is further above or below was a mistake of the tracking."""
_TILE_M = 2.5


def floor_from_path(
    timestamps: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"], stature: float
) -> Float[Tensor, "time"]:
    """Floor height (m) beneath each head position from the head alone: its usual height within half a minute, less
    `stature`, the head joint's height in the rest pose (m). Stairs are followed late, long sits mistaken for steps.
    """
    every = torch.arange(timestamps[0].item(), timestamps[-1].item() + _LOOK_EVERY_S, _LOOK_EVERY_S).double()
    seen = interpolate_clamped(timestamps, t_world_head[:, 2], every).numpy()
    upright = percentile_filter(seen, 90, size=int(UPRIGHT_WITHIN_S / _LOOK_EVERY_S), mode="nearest")
    return interpolate_clamped(every, torch.from_numpy(np.asarray(upright) - stature).float(), timestamps)


def floor_from_points(
    cloud: PointCloud | None, t_world_head: Float[Tensor, "time 3"], stature: float
) -> Float[Tensor, "time"] | None:
    """Floor height (m) beneath each head position from points; None where there are too few.

    `stature` is the head joint's height in the rest pose (m).
    """
    if cloud is None:
        return None
    points = cloud.points_world[cloud.points_world.isfinite().all(-1)]
    if len(points) < MIN_POINTS:
        return None
    return estimate_floor(points, t_world_head, stature).height


class FloorTracker:
    """The floor beneath a moving head from what has been seen so far, for captures that run while things happen.

    It looks again once in `LOOK_FRAMES` frames, at the last metres of the path and the points around them.
    """

    def __init__(self, stature: float, fps: float):
        """`stature` is the head joint's height in the rest pose (m); `fps` the rate of the poses to come."""
        self.stature = stature
        self._heights: deque[float] = deque(maxlen=int(UPRIGHT_WITHIN_S * fps / LOOK_FRAMES))
        self._path: deque[np.ndarray] = deque(maxlen=int(RECENT_S * fps / LOOK_FRAMES))
        self._tiles: defaultdict[tuple[int, int], list[np.ndarray]] = defaultdict(list)
        self.frames = 0
        """Followed so far."""
        self._height = 0.0

    def state(self) -> dict[str, Tensor]:
        """Everything but the points, which are to be shown again."""
        return {
            "heights": torch.tensor(list(self._heights), dtype=torch.float64),
            "path": torch.from_numpy(np.array(self._path).reshape(-1, 3)),
            "now": torch.tensor([self.frames, self._height], dtype=torch.float64),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` gave."""
        self._heights.extend(state["heights"].tolist())
        self._path.extend(state["path"].numpy())
        frames, self._height = state["now"].tolist()
        self.frames = int(frames)

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        """Take in points (m); those that are not finite are left out."""
        points = points_world.detach().cpu().numpy()
        points = points[np.isfinite(points).all(1)]
        tiles, which = np.unique(
            np.floor(points[:, :2] / _TILE_M).astype(np.int64), axis=0, return_inverse=True
        )
        for number, (x, y) in enumerate(tiles.tolist()):
            self._tiles[x, y].append(points[which.reshape(-1) == number])

    def follow(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        """Floor height (m) beneath the next head positions."""
        floor = torch.empty(len(t_world_head))
        done = 0
        while done < len(floor):
            if self.frames % LOOK_FRAMES == 0:
                self._look(t_world_head[done].double().numpy())
            ready = min(len(floor) - done, LOOK_FRAMES - self.frames % LOOK_FRAMES)
            floor[done : done + ready] = self._height
            done, self.frames = done + ready, self.frames + ready
        return floor

    def _look(self, head: np.ndarray) -> None:
        self._heights.append(float(head[2]))
        self._path.append(head)
        points = self._around()
        if len(points) >= MIN_POINTS:
            path = np.array(self._path)
            path = torch.from_numpy(path[np.abs(path[:, 2] - head[2]) <= _STOREYS_M])
            cloud = torch.from_numpy(points)
            with suppress(WearcapError):  # none of them lies beneath the path: the last answer stands
                self._height = float(estimate_floor(cloud, path, self.stature).height[-1])
        else:
            self._height = float(np.percentile(self._heights, 90)) - self.stature

    def _around(self) -> np.ndarray:
        """Points in the tiles that the recent path crosses, and next to them."""
        crossed = np.unique(np.floor(np.array(self._path)[:, :2] / _TILE_M).astype(np.int64), axis=0)
        near = {(x + i, y + j) for x, y in crossed.tolist() for i in (-1, 0, 1) for j in (-1, 0, 1)}
        parts = []
        for tile in sorted(near & self._tiles.keys()):
            if len(self._tiles[tile]) > 1:
                self._tiles[tile] = [np.concatenate(self._tiles[tile])]
            parts += self._tiles[tile]
        return np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)


def tracked_floor(
    cloud: PointCloud | None,
    timestamps: Float64[Tensor, "time"],
    t_world_head: Float[Tensor, "time 3"],
    stature: float,
    fps: float,
) -> Float[Tensor, "time"]:
    """Floor height (m) beneath each head position from what had been seen by then: what `FloorTracker` says.

    Points without a time count from the beginning.
    """
    tracker = FloorTracker(stature, fps)
    points, seen = torch.zeros(0, 3), torch.zeros(0, dtype=torch.float64)
    if cloud is not None and cloud.first_seen is None:
        tracker.see(cloud.points_world)
    elif cloud is not None and cloud.first_seen is not None:
        seen, order = cloud.first_seen.sort(stable=True)
        points = cloud.points_world[order]
    floor = torch.empty(len(timestamps))
    taken = 0
    for start in range(0, len(timestamps), LOOK_FRAMES):
        until = int(torch.searchsorted(seen, timestamps[start], right=True))
        if until > taken:
            tracker.see(points[taken:until])
            taken = until
        floor[start : start + LOOK_FRAMES] = tracker.follow(t_world_head[start : start + LOOK_FRAMES])
    return floor
