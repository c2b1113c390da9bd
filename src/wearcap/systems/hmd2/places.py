"""What a stream remembers of the places around its wearer, and what it tells of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.scene.voxels import VoxelGrid, VoxelMap
from wearcap.tracking.floor import LOOK_FRAMES, FloorTracker

MANY = 4
"""So many times the points that a stream may keep are too many, even while the head is not tracked."""


@dataclass(frozen=True)
class Memory:
    """How much of the points a stream keeps. Whoever comes back to a place that was forgotten must be shown it again."""

    radius_m: float = 20.0
    """Points so far away (horizontally) are forgotten, at the latest when the wearer has walked half of it; inf: none."""
    max_points: int = 1_000_000
    """Of more, the newer half is kept (about 100 bytes each)."""

    def __post_init__(self):
        if not self.radius_m >= 5.0 or self.max_points < 1000:
            raise WearcapError(f"a memory of {self.max_points} points within {self.radius_m} m",
                               expected="at least 1000 points within at least 5 m")  # fmt: skip


class Places:
    """Points around one wearer and the floor beneath, as seen so far."""

    def __init__(self, grid: VoxelGrid, stature: float, fps: float, memory: Memory):
        """`stature` is the head joint's height in the rest pose (m)."""
        self.grid, self.memory = grid, memory
        self.mapped = False
        """Whether points ever came, be it none of them."""
        self._about = stature, fps
        self._map, self._floor = VoxelMap(grid), FloorTracker(stature, fps)
        self._known: list[tuple[Tensor, Tensor]] = []
        """Points, and when they were seen, that the floor's tracker knows …"""
        self._new: list[tuple[Tensor, Tensor]] = []
        """… and those of frames to come."""
        self._center: Tensor | None = None
        """Where points were forgotten last."""

    def state(self) -> dict[str, Tensor]:
        points, seen = _joined(self._known + self._new)
        observed = torch.tensor([len(_joined(self._known)[0]), self.mapped])
        center = torch.zeros(0) if self._center is None else self._center
        here = {"points": points, "seen": seen, "known": observed, "center": center}
        return here | {f"floor.{name}": part for name, part in self._floor.state().items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        observed, mapped = state["known"].tolist()
        self.mapped, points, seen = bool(mapped), state["points"], state["seen"]
        self._center = state["center"] if len(state["center"]) else None
        self._new = [(points[observed:], seen[observed:])]
        self._map.add(*self._new[0])
        floor = {
            name.removeprefix("floor."): part for name, part in state.items() if name.startswith("floor.")
        }
        self._begin([(points[:observed], seen[:observed])], floor)

    def add(self, points_world: Float[Tensor, "point 3"], first_seen: float) -> None:
        """Take in points (m) that were seen first at a time (s); those that are not finite are left out."""
        points = points_world.detach().float().cpu()
        points = points[points.isfinite().all(-1)]
        seen = torch.full((len(points),), first_seen, dtype=torch.float64)
        self.mapped = True
        self._map.add(points, seen)
        self._new.append((points, seen))
        if len(self._map) > MANY * self.memory.max_points:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        """While no frame comes that would forget points, the newest packets of them stay."""
        kept, count = [], 0
        while self._new and (not kept or count + len(self._new[-1][0]) <= self.memory.max_points):
            kept.append(self._new.pop())
            count += len(kept[-1][0])
        observed = [_joined(self._known)]
        self._map, self._new = VoxelMap(self.grid), kept[::-1]
        for part in self._new:
            self._map.add(*part)
        self._begin(observed, self._floor.state())

    def grids(
        self, T_world_device: Rigid, timestamps: Float64[Tensor, "time"]
    ) -> Float[Tensor, "time x y z"]:
        """Grids of the points seen by each frame's time."""
        return self._map.voxelize(T_world_device, timestamps)

    def floor(
        self, timestamps: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"]
    ) -> Float[Tensor, "time"]:
        """Floor height (m) beneath the next frames of the head; looks as `tracking.floor.tracked_floor` does."""
        parts, done = [], 0
        while done < len(timestamps):
            if self._floor.frames % LOOK_FRAMES == 0:
                self._show(timestamps[done].item())
            ready = LOOK_FRAMES - self._floor.frames % LOOK_FRAMES
            parts.append(self._floor.follow(t_world_head[done : done + ready]))
            done += ready
        self._forget(t_world_head[-1])
        return torch.cat(parts)

    def _show(self, until: float) -> None:
        """Show the floor's tracker what was seen by then."""
        shown = [part for part in self._new if len(part[1]) and part[1][0] <= until]
        if shown:
            self._new = [part for part in self._new if len(part[1]) and part[1][0] > until]
            self._known.append(_joined(shown))
            self._floor.see(self._known[-1][0])
        if len(self._known) > 1000:
            self._known = [_joined(self._known)]

    def _forget(self, t_world_head: Float[Tensor, "3"]) -> None:
        """Once the wearer has gone far, or points are many, leave out what is far and old."""
        center = t_world_head if self._center is None else self._center
        self._center, moved = center, float((t_world_head - center)[:2].norm())
        if moved < 0.5 * self.memory.radius_m and len(self._map) <= self.memory.max_points:
            return
        self._center = t_world_head
        points, seen = _joined(self._known)
        near = (points - t_world_head)[:, :2].norm(dim=-1) <= self.memory.radius_m
        points, seen = points[near], seen[near]
        if len(points) > self.memory.max_points // 2:
            points, seen = points[-(self.memory.max_points // 2) :], seen[-(self.memory.max_points // 2) :]
        self._map = VoxelMap(self.grid)
        for part in self._new:
            self._map.add(*part)
        self._begin([(points, seen)], self._floor.state())

    def _begin(self, observed: list[tuple[Tensor, Tensor]], floor: dict[str, Tensor]) -> None:
        """Go on with these known points alone."""
        self._known, self._floor = observed, FloorTracker(*self._about)
        self._floor.restore(floor)
        for points, seen in observed:
            self._map.add(points, seen)
            self._floor.see(points)


def _joined(parts: list[tuple[Tensor, Tensor]]) -> tuple[Float[Tensor, "point 3"], Float64[Tensor, "point"]]:
    if not parts:
        return torch.zeros(0, 3), torch.zeros(0, dtype=torch.float64)
    points, seen = zip(*parts)
    return torch.cat(points), torch.cat(seen)
