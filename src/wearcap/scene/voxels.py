"""Voxel grids of truncated distances to the wearer's surroundings, one per frame (thesis §6.2.1)."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.voxel_kernels import BLOCK, FREE, fill_grids, insert, rehash

_TILE_M = 0.3


@dataclass(frozen=True)
class VoxelGrid:
    """A cube of cells below the device, aligned to its yaw: axes x forward, y left, z up."""

    cells: int = 10
    """Cells along each edge."""
    size_m: float = 2.0
    below_m: float = 1.0
    """The cube's centre lies this far below the device."""
    clip_m: float = 0.1
    """Truncation distance (m); at most half a cell's edge, so that a point affects only its own cell."""

    def __post_init__(self):
        if self.cells < 1 or not 0 < self.clip_m <= 0.5 * self.cell_m * (1 + 1e-9):
            raise WearcapError(
                f"a voxel grid of {self.cells} cells in {self.size_m} m, distances up to {self.clip_m} m",
                expected=f"distances up to half a cell ({0.5 * self.cell_m:g} m)",
            )

    @property
    def cell_m(self) -> float:
        """Edge of a cell."""
        return self.size_m / max(self.cells, 1)


def voxelize(
    points_world: Float[Tensor, "point 3"],
    T_world_device: Rigid,
    grid: VoxelGrid = VoxelGrid(),
    first_seen: Float64[Tensor, "point"] | None = None,
    timestamps: Float64[Tensor, "time"] | None = None,
) -> Float[Tensor, "time x y z"]:
    """Distance (m) from each cell's centre to the nearest point, clipped to `clip_m` (thesis §6.2.1), of every frame.

    With `first_seen` and `timestamps` (s) a point counts from the time at which it was first seen; without either, all
    points count in all frames. Points that are not finite are ignored; frames whose pose is not finite see none.
    """
    everything = VoxelMap(grid)
    everything.add(points_world, first_seen)
    return everything.voxelize(T_world_device, timestamps)


class VoxelMap:
    """Points of the surroundings, to which more can be added at any time, and the grids seen from any pose.

    Equal to `voxelize` on all points added so far. An added point costs a step in a hash table, however large the map.
    """

    def __init__(self, grid: VoxelGrid = VoxelGrid()):
        self.grid = grid
        self.count, self.dropped = 0, 0
        """Points kept, and points left out because they were not finite."""
        self._used = np.zeros(2, np.int64)
        self._tiles = self._free_tiles(1 << 10)
        self._blocks = _free_blocks(1 << 9)

    def __len__(self) -> int:
        return self.count

    @staticmethod
    def _free_tiles(size: int) -> tuple[np.ndarray, ...]:
        return np.full(size, FREE, np.int64), np.empty(size, np.int32), np.empty(size, np.int32)

    def add(self, points_world: Float[Tensor, "point 3"], first_seen: Float64[Tensor, "point"] | None = None) -> None:
        """Take in points (m), seen at `first_seen` (s), or always."""
        points = points_world.detach().cpu().to(torch.float32)
        seen = (
            first_seen.cpu() if first_seen is not None else torch.full((len(points),), -math.inf, dtype=torch.float64)
        )
        usable = points.isfinite().all(-1) & ~seen.isnan()
        if not usable.all():
            self.dropped += int((~usable).sum())
            points, seen = points[usable], seen[usable]
        self.count += len(points)
        rows, times, start = points.contiguous().numpy(), seen.contiguous().numpy(), 0
        while start < len(rows):
            self._make_room()
            start = insert(rows, times, start, _TILE_M, self._used, *self._tiles, *self._blocks)

    def _make_room(self) -> None:
        tiles, blocks = self._used.tolist()
        if 2 * tiles >= len(self._tiles[0]):
            larger = self._free_tiles(2 * len(self._tiles[0]))
            rehash(*self._tiles, *larger)
            self._tiles = larger
        if blocks >= len(self._blocks[-1]):
            larger = _free_blocks(2 * blocks)
            for new, old in zip(larger, self._blocks):
                new[:blocks] = old
            self._blocks = larger

    def voxelize(
        self, T_world_device: Rigid, timestamps: Float64[Tensor, "time"] | None = None
    ) -> Float[Tensor, "time x y z"]:
        """Grids (m) of every frame, of the points seen by its timestamp, or of all without timestamps."""
        grid, frames = self.grid, len(T_world_device.t)
        yaws = rotation.yaw_of(T_world_device.R.detach().cpu().double()).contiguous()
        times = torch.full((frames,), math.inf, dtype=torch.float64) if timestamps is None else timestamps.cpu()
        grids = torch.empty(frames, grid.cells, grid.cells, grid.cells)
        fill_grids(
            T_world_device.t.detach().cpu().float().contiguous().numpy(),
            yaws.numpy(),
            times.contiguous().numpy(),
            0.5 * grid.size_m,
            grid.below_m,
            grid.clip_m,
            _TILE_M,
            *self._tiles,
            *self._blocks,
            grids.numpy(),
        )
        return grids


def _free_blocks(size: int) -> tuple[np.ndarray, ...]:
    """Empty blocks: points, first-seen times (NaN: unused), and the index of the preceding block."""
    points = np.zeros((size, 3, BLOCK), np.float32)
    return points, np.full((size, BLOCK), np.nan), np.empty(size, np.int32)


def mirrored(grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch x y z"]:
    """The grids mirrored, left and right swapped."""
    return grids.flip(-2)
