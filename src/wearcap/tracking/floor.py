"""Floor height below the wearer, estimated from points of the surroundings or from the head's path alone."""

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
"""Fewest points that a floor is estimated from."""
CARRIED = 0.985
"""How high people carry the head joint while upright, as a share of its height in the rest pose: neck, hips and knees are a
little bent. Medians of people in the training splits: CMU 0.980, ACCAD 0.984, FuBoT-VR 0.980, UI-PRMD 0.993, simulated 0.998
(`benchmarks/carried_heads.py`)."""
UPRIGHT_WITHIN_S = 30.0
"""People are assumed to be upright for a tenth of any interval of this length (s)."""
_LOOK_EVERY_S = 0.25
"""Sampling interval (s) of the head's height in `floor_from_path`."""
LOOK_FRAMES = 10
"""Frames between updates of a tracked floor."""
RECENT_S = 6.0
"""Length of the recent path (s) that a tracked floor is estimated for."""
_STOREYS_M = 30.0
"""Height difference (m) that no path covers in `RECENT_S`; positions beyond it are tracking errors."""
_TILE_M = 2.5
"""Side of the square tiles (m) that sort a tracker's points."""


def floor_from_path(
    timestamps: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"], stature: float
) -> Float[Tensor, "time"]:
    """Floor height (m) below each head position from the head alone: the 90th percentile of its height within half a
    minute, minus `stature`, the head joint's height in the rest pose (m). Stairs are followed late; long sitting is
    mistaken for a step down.
    """
    every = torch.arange(timestamps[0].item(), timestamps[-1].item() + _LOOK_EVERY_S, _LOOK_EVERY_S).double()
    seen = interpolate_clamped(timestamps, t_world_head[:, 2], every).numpy()
    upright = percentile_filter(seen, 90, size=int(UPRIGHT_WITHIN_S / _LOOK_EVERY_S), mode="nearest")
    return interpolate_clamped(every, torch.from_numpy(np.asarray(upright) - stature).float(), timestamps)


def floor_from_points(
    cloud: PointCloud | None, t_world_head: Float[Tensor, "time 3"], stature: float
) -> Float[Tensor, "time"] | None:
    """Floor height (m) below each head position from points; None if there are too few.

    `stature` is the head joint's height in the rest pose (m).
    """
    if cloud is None:
        return None
    points = cloud.points_world[cloud.points_world.isfinite().all(-1)]
    if len(points) < MIN_POINTS:
        return None
    return estimate_floor(points, t_world_head, stature).height


class FloorTracker:
    """Estimates the floor below a moving head from the data so far, for streaming captures.

    Every `LOOK_FRAMES` frames it is estimated again from the recent path and the points around it.
    """

    def __init__(self, stature: float, fps: float):
        """`stature` is the head joint's height in the rest pose (m), `fps` the frame rate of the poses."""
        self.stature = stature
        self._heights: deque[float] = deque(maxlen=int(UPRIGHT_WITHIN_S * fps / LOOK_FRAMES))
        self._path: deque[np.ndarray] = deque(maxlen=int(RECENT_S * fps / LOOK_FRAMES))
        self._tiles: defaultdict[tuple[int, int], list[np.ndarray]] = defaultdict(list)
        self.frames = 0
        """Number of frames so far."""
        self._height = 0.0

    def forget(self) -> None:
        """Forget all points."""
        self._tiles = defaultdict(list)

    def see(self, points_world: Float[Tensor, "point 3"]) -> None:
        """Add points (m); points that are not finite are left out."""
        points = points_world.detach().cpu().numpy()
        points = points[np.isfinite(points).all(1)]
        tiles, which = np.unique(np.floor(points[:, :2] / _TILE_M).astype(np.int64), axis=0, return_inverse=True)
        for number, (x, y) in enumerate(tiles.tolist()):
            self._tiles[x, y].append(points[which.reshape(-1) == number])

    def follow(self, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
        """Floor height (m) below the next head positions."""
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
        # Points in the tiles that the recent path crosses and in the adjacent tiles
        crossed = np.unique(np.floor(np.array(self._path)[:, :2] / _TILE_M).astype(np.int64), axis=0)
        near = {(x + i, y + j) for x, y in crossed.tolist() for i in (-1, 0, 1) for j in (-1, 0, 1)}
        parts = []
        for tile in sorted(near & self._tiles.keys()):
            if len(self._tiles[tile]) > 1:
                self._tiles[tile] = [np.concatenate(self._tiles[tile])]
            parts += self._tiles[tile]
        points = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
        if len(points) >= MIN_POINTS:
            path = np.array(self._path)
            path = torch.from_numpy(path[np.abs(path[:, 2] - head[2]) <= _STOREYS_M])
            cloud = torch.from_numpy(points)
            with suppress(WearcapError):  # no point is below the path: the last height stays
                self._height = float(estimate_floor(cloud, path, self.stature).height[-1])
        else:
            self._height = float(np.percentile(self._heights, 90)) - self.stature
