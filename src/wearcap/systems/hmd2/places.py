"""A wearer's map of the points around: voxel grids for the model, and the floor below the head."""

import math
import sys
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.scene.voxels import VoxelGrid, VoxelMap
from wearcap.tracking.floor import LOOK_FRAMES, FloorTracker

MANY = 4
"""Factor of `Memory.max_points` above which old points are dropped even while the head is not tracked."""


@dataclass(frozen=True)
class Memory:
    """Limits on the points that a stream keeps. Points that were dropped do not return when the wearer does."""

    radius_m: float = 20.0
    """Horizontal distance (m) beyond which points are dropped, at the latest after walking half of it; inf: never."""
    max_points: int = 1_000_000
    """Number of points (about 100 bytes each) above which only the newest are kept, half as many."""

    def __post_init__(self):
        if not self.radius_m >= 5.0 or self.max_points < 1000:
            what = f"a memory of {self.max_points} points within {self.radius_m} m"
            raise WearcapError(what, expected="at least 1000 points within at least 5 m")


EVERYTHING = Memory(math.inf, sys.maxsize)
"""Of a whole recording: nothing is dropped."""


class Places:
    """Points around one wearer and the floor below, as seen so far."""

    def __init__(self, grid: VoxelGrid, stature: float, fps: float, memory: Memory):
        """`stature` is the head joint's height in the rest pose (m)."""
        self.grid, self.memory = grid, memory
        self.mapped = False
        """Whether any packet of points arrived, even an empty one."""
        self.map, self._floor = VoxelMap(grid), FloorTracker(stature, fps)
        self._tracked: list[tuple[Tensor, Tensor]] = []
        """Points and the times they were first seen, as far as the floor tracker has them."""
        self._new: list[tuple[Tensor, Tensor]] = []
        """Points and times that the floor tracker does not have yet, since no frame has reached those times."""
        self._center: Tensor | None = None
        """Head position at which distant points were dropped last (m)."""

    def add(self, points_world: Float[Tensor, "point 3"], first_seen: Float64[Tensor, "point"] | None) -> None:
        """Add points (m) with the times they were first seen (s), None: always; points that are not finite are left
        out."""
        points = points_world.detach().float().cpu()
        finite, self.mapped = points.isfinite().all(-1), True
        seen = torch.full((len(points),), -math.inf, dtype=torch.float64) if first_seen is None else first_seen
        points, seen = points[finite], seen[finite]
        self.map.add(points, seen)
        self._new.append(_joined([(points, seen)]))
        if len(self.map) > MANY * self.memory.max_points:  # no frame arrives that would drop distant points
            points, seen = _joined(self._new)
            newest = slice(-self.memory.max_points, None)
            self._rebuild(_joined(self._tracked), (points[newest], seen[newest]))

    def floor(
        self, timestamps: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"]
    ) -> Float[Tensor, "time"]:
        """Floor height (m) below the head at the next frames, from the points and the path so far."""
        parts, done = [], 0
        while done < len(timestamps):
            if self._floor.frames % LOOK_FRAMES == 0:
                self._show(timestamps[done].item())
            ready = LOOK_FRAMES - self._floor.frames % LOOK_FRAMES
            parts.append(self._floor.follow(t_world_head[done : done + ready]))
            done += ready
        self._forget(t_world_head[-1])
        return torch.cat(parts)

    def _show(self, until_s: float) -> None:
        """Give the tracker the points that were seen by a time."""
        if not self._new:
            return
        points, seen = _joined(self._new) if len(self._new) > 1 else self._new[0]
        count = int(torch.searchsorted(seen, until_s, right=True))
        self._new = [(points[count:], seen[count:])] if count < len(points) else []
        if count:
            self._tracked.append((points[:count], seen[:count]))
            self._floor.see(points[:count])
        if len(self._tracked) > 1000:
            self._tracked = [_joined(self._tracked)]

    def _forget(self, t_world_head: Float[Tensor, "3"]) -> None:
        """Drop distant and old points once the wearer has walked far or there are too many points."""
        center = t_world_head if self._center is None else self._center
        self._center, moved = center, float((t_world_head - center)[:2].norm())
        if moved < 0.5 * self.memory.radius_m and len(self.map) <= self.memory.max_points:
            return
        self._center = t_world_head
        points, seen = _joined(self._tracked)
        near = (points - t_world_head)[:, :2].norm(dim=-1) <= self.memory.radius_m
        newest = slice(-(self.memory.max_points // 2), None)
        self._rebuild((points[near][newest], seen[near][newest]), _joined(self._new))

    def _rebuild(self, tracked: tuple[Tensor, Tensor], new: tuple[Tensor, Tensor]) -> None:
        """Replace all points by these."""
        self.map, self._tracked, self._new = VoxelMap(self.grid), [tracked], [new]
        self._floor.forget()
        self._floor.see(tracked[0])
        for points, seen in (new, tracked):
            self.map.add(points, seen)


def _joined(parts: list[tuple[Tensor, Tensor]]) -> tuple[Float[Tensor, "point 3"], Float64[Tensor, "point"]]:
    """Points and times of several packets, in order of time."""
    points, seen = zip(*parts) if parts else ((torch.zeros(0, 3),), (torch.zeros(0, dtype=torch.float64),))
    times, order = torch.cat(seen).sort(stable=True)
    return torch.cat(points)[order], times
