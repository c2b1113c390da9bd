"""Voxel grids of truncated distances to the wearer's surroundings, one per frame (thesis §6.2.1).

The map keeps points in blocks, blocks in chains by tile, tiles in a hash table. A tile is a cube of space, known by its
key; its chain starts at the block filled last. Keys of tiles 2^21 tiles apart agree: their points share a chain, and
the distance sorts them out. The compiled loops pass two tuples of arrays around: tiles (keys, last block and number of
points of each tile) and blocks (points, first-seen times, and the block before each in its chain).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.compiled import compiled
from wearcap.geometry.rigid import Rigid

_TILE_M = 0.3
_BLOCK = 32
"""Number of points of a block, which lie beside one another in memory."""
_FREE = -1
"""Key of an empty place in the hash table, and end of a chain."""
_KEY_MASK = (1 << 21) - 1
_HASH_FACTOR = -7046029254386353131  # 2^64 / golden ratio (Knuth's multiplicative hashing)


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
            what = f"a voxel grid of {self.cells} cells in {self.size_m} m, distances up to {self.clip_m} m"
            raise WearcapError(what, expected=f"distances up to half a cell ({0.5 * self.cell_m:g} m)")

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
        self._count = 0
        self._used = np.zeros(2, np.int64)
        self._tiles = _free_tiles(1 << 10)
        self._blocks = _free_blocks(1 << 9)

    def __len__(self) -> int:
        return self._count

    def add(self, points_world: Float[Tensor, "point 3"], first_seen: Float64[Tensor, "point"] | None = None) -> None:
        """Take in points (m), seen at `first_seen` (s), or always; points that are not finite are left out."""
        points = points_world.detach().cpu().to(torch.float32)
        seen = (
            first_seen.cpu() if first_seen is not None else torch.full((len(points),), -math.inf, dtype=torch.float64)
        )
        usable = points.isfinite().all(-1) & ~seen.isnan()
        rows, times, start = points[usable].numpy(), seen[usable].numpy(), 0
        self._count += len(rows)
        while start < len(rows):
            tiles, blocks = self._used.tolist()
            if 2 * tiles >= len(self._tiles[0]):
                larger = _free_tiles(2 * len(self._tiles[0]))
                _rehash(self._tiles, larger)
                self._tiles = larger
            if blocks >= len(self._blocks[-1]):
                larger = _free_blocks(2 * blocks)
                for new, old in zip(larger, self._blocks):
                    new[:blocks] = old
                self._blocks = larger
            start = _insert(rows, times, start, self._used, self._tiles, self._blocks)

    def voxelize(
        self, T_world_device: Rigid, timestamps: Float64[Tensor, "time"] | None = None
    ) -> Float[Tensor, "time x y z"]:
        """Grids (m) of every frame, of the points seen by its timestamp, or of all without timestamps."""
        grid, frames = self.grid, len(T_world_device.t)
        yaws = rotation.yaw_of(T_world_device.R.detach().cpu().double()).contiguous()
        times = torch.full((frames,), math.inf, dtype=torch.float64) if timestamps is None else timestamps.cpu()
        grids = torch.empty(frames, grid.cells, grid.cells, grid.cells)
        places = T_world_device.t.detach().cpu().float().contiguous().numpy()
        box = 0.5 * grid.size_m, grid.below_m, grid.clip_m
        when = times.contiguous().numpy()
        _fill_grids(places, yaws.numpy(), when, *box, self._tiles, self._blocks, grids.numpy())
        return grids


def _free_tiles(size: int) -> tuple[np.ndarray, ...]:
    return np.full(size, _FREE, np.int64), np.empty(size, np.int32), np.empty(size, np.int32)


def _free_blocks(size: int) -> tuple[np.ndarray, ...]:
    """Empty blocks: points, first-seen times (NaN: unused), and the index of the preceding block."""
    points = np.zeros((size, 3, _BLOCK), np.float32)
    return points, np.full((size, _BLOCK), np.nan), np.empty(size, np.int32)


def mirrored(grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch x y z"]:
    """The grids mirrored, left and right swapped."""
    return grids.flip(-2)


@compiled
def _tile_key(ix, iy, iz):
    return ((ix & _KEY_MASK) << 42) | ((iy & _KEY_MASK) << 21) | (iz & _KEY_MASK)


@compiled
def _place_of(keys, key):
    """Where a key stands in the hash table, or the free place where it would stand; its size is a power of two."""
    mask = len(keys) - 1
    place = ((key * _HASH_FACTOR) >> 20) & mask
    while keys[place] != key and keys[place] != _FREE:
        place = (place + 1) & mask
    return place


@compiled
def _rehash(tiles, larger):
    """Carry the tiles into a larger, empty table."""
    keys, chains, counts = tiles
    new_keys, new_chains, new_counts = larger
    for old in range(len(keys)):
        if keys[old] != _FREE:
            place = _place_of(new_keys, keys[old])
            new_keys[place], new_chains[place], new_counts[place] = keys[old], chains[old], counts[old]


@compiled
def _insert(points, first_seen, start, used, tiles, blocks):
    """Put points start, start + 1 … into their tiles until a table is full; returns the first that found no room.

    `used`: (tiles, blocks) in use, counted on.
    """
    keys, chains, counts = tiles
    block_points, block_seen, before = blocks
    for number in range(start, len(points)):
        if 2 * used[0] >= len(keys) or used[1] >= len(before):
            return number
        x, y, z = points[number, 0], points[number, 1], points[number, 2]
        key = _tile_key(math.floor(x / _TILE_M), math.floor(y / _TILE_M), math.floor(z / _TILE_M))
        place = _place_of(keys, key)
        if keys[place] == _FREE:
            keys[place] = key
            chains[place], counts[place] = _FREE, 0
            used[0] += 1
        row = counts[place] % _BLOCK
        if row == 0:
            before[used[1]] = chains[place]
            chains[place] = used[1]
            used[1] += 1
        block = chains[place]
        block_points[block, 0, row], block_points[block, 1, row], block_points[block, 2, row] = x, y, z
        block_seen[block, row] = first_seen[number]
        counts[place] += 1
    return len(points)


@compiled
def _lower(points, seen, time, place, frame, cells, cell, square, squares):
    """Lower `squares` (cells², of padded cells) by the points of one block that were seen by `time`.

    place: the device (3); frame: cosine and sine of its yaw per cell's edge, cells per metre, and the device's place
    in the box (along x and y alike, along z), in cells. Cells lie within a border of one cell, which takes
    all points outside the box. `cell` and `square` are scratch: without branches their loop becomes vector code.
    """
    cosine, sine, per_m, middle, above = frame[0], frame[1], frame[2], frame[3], frame[4]
    x, y, z = place[0], place[1], place[2]
    low, high, half, far = np.float32(-1), np.float32(cells), np.float32(0.5), np.float32(1e6)
    side = np.int32(cells + 2)
    for row in range(_BLOCK):
        ahead, aside = points[0, row] - x, points[1, row] - y
        u = cosine * ahead + sine * aside + middle
        v = cosine * aside - sine * ahead + middle
        w = per_m * (points[2, row] - z) + above
        fu, fv, fw = np.floor(u), np.floor(v), np.floor(w)
        du, dv, dw = u - fu - half, v - fv - half, w - fw - half
        fu, fv, fw = (fu if fu > low else low), (fv if fv > low else low), (fw if fw > low else low)
        fu, fv, fw = (fu if fu < high else high), (fv if fv < high else high), (fw if fw < high else high)
        cell[row] = ((np.int32(fu) + 1) * side + np.int32(fv) + 1) * side + np.int32(fw) + 1
        square[row] = du * du + dv * dv + dw * dw if seen[row] <= time else far
    for row in range(_BLOCK):
        old = squares[cell[row]]
        squares[cell[row]] = square[row] if square[row] < old else old


@compiled
def _fill_grids(places, yaws, times, half, below, clip, tiles, blocks, grids):
    """Distance (m) from every cell's centre to the nearest point of that cell seen by then, at most `clip`.

    places (frame, 3) and yaws (rad) of the device; the box of half edge `half` has its centre `below` under it. A frame
    that is not finite has no points. grids (frame, cells, cells, cells) is filled.
    """
    keys, chains, _ = tiles
    block_points, block_seen, before = blocks
    tile, cells = _TILE_M, grids.shape[1]
    edge = 2.0 * half / cells
    nothing = np.float32((clip / edge) ** 2)
    squares = np.empty((cells + 2) ** 3, np.float32)
    cell, square, frame_of = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.float32), np.empty(5, np.float32)
    for frame in range(len(places)):
        x, y, z = float(places[frame, 0]), float(places[frame, 1]), places[frame, 2] - below
        cosine, sine = math.cos(yaws[frame]), math.sin(yaws[frame])
        squares[:] = nothing
        if math.isfinite(x + y + z + cosine + sine):
            frame_of[0], frame_of[1], frame_of[2] = cosine / edge, sine / edge, 1.0 / edge
            frame_of[3], frame_of[4] = 0.5 * cells, 0.5 * cells + below / edge
            across = half * (abs(cosine) + abs(sine))
            reach = half + 0.5 * tile * (abs(cosine) + abs(sine))
            for ix in range(math.floor((x - across) / tile), math.floor((x + across) / tile) + 1):
                for iy in range(math.floor((y - across) / tile), math.floor((y + across) / tile) + 1):
                    ahead, aside = (ix + 0.5) * tile - x, (iy + 0.5) * tile - y
                    if abs(cosine * ahead + sine * aside) > reach or abs(cosine * aside - sine * ahead) > reach:
                        continue
                    for iz in range(math.floor((z - half) / tile), math.floor((z + half) / tile) + 1):
                        slot = _place_of(keys, _tile_key(ix, iy, iz))
                        block = chains[slot] if keys[slot] != _FREE else _FREE
                        while block != _FREE:
                            seen_by, place = times[frame], places[frame]
                            points, seen = block_points[block], block_seen[block]
                            _lower(points, seen, seen_by, place, frame_of, cells, cell, square, squares)
                            block = before[block]
        for i in range(cells):
            for j in range(cells):
                first = ((i + 1) * (cells + 2) + j + 1) * (cells + 2) + 1
                for k in range(cells):
                    grids[frame, i, j, k] = min(clip, edge * math.sqrt(squares[first + k]))
