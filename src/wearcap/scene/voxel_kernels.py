"""Compiled loops of the voxel map: points in blocks, blocks in chains by tile, tiles in a hash table.

A tile is a cube of space, known by its key; its chain starts at the block filled last. A block holds `BLOCK` points
that lie beside one another in memory. Keys of tiles 2^21 tiles apart agree: their points share a chain, and the
distance sorts them out.
"""

import math

import numpy as np

from wearcap.geometry.compiled import compiled

BLOCK = 32
FREE = -1
"""Key of an empty place in the hash table, and end of a chain."""
_MASK = (1 << 21) - 1
_SPREAD = -7046029254386353131  # 2^64 / golden ratio (Knuth's multiplicative hashing)


@compiled
def tile_key(ix, iy, iz):
    return ((ix & _MASK) << 42) | ((iy & _MASK) << 21) | (iz & _MASK)


@compiled
def place_of(keys, key):
    """Where a key stands in the hash table, or the free place where it would stand; its size is a power of two."""
    mask = len(keys) - 1
    place = ((key * _SPREAD) >> 20) & mask
    while keys[place] != key and keys[place] != FREE:
        place = (place + 1) & mask
    return place


@compiled
def rehash(keys, chains, counts, new_keys, new_chains, new_counts):
    """Carry the tiles into a larger, empty table."""
    for old in range(len(keys)):
        if keys[old] != FREE:
            place = place_of(new_keys, keys[old])
            new_keys[place], new_chains[place], new_counts[place] = keys[old], chains[old], counts[old]


@compiled
def insert(points, first_seen, start, tile, used, keys, chains, counts, block_points, block_seen, before):
    """Put points start, start + 1 … into their tiles until a table is full; returns the first that found no room.

    `used`: (tiles, blocks) in use, counted on. chains, counts: last block and number of points of each tile;
    `before`: the block before a block in its chain.
    """
    for number in range(start, len(points)):
        if 2 * used[0] >= len(keys) or used[1] >= len(before):
            return number
        x, y, z = points[number, 0], points[number, 1], points[number, 2]
        place = place_of(keys, tile_key(math.floor(x / tile), math.floor(y / tile), math.floor(z / tile)))
        if keys[place] == FREE:
            keys[place] = tile_key(math.floor(x / tile), math.floor(y / tile), math.floor(z / tile))
            chains[place], counts[place] = FREE, 0
            used[0] += 1
        row = counts[place] % BLOCK
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
    for row in range(BLOCK):
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
    for row in range(BLOCK):
        old = squares[cell[row]]
        squares[cell[row]] = square[row] if square[row] < old else old


@compiled
def fill_grids(
    places, yaws, times, half, below, clip, tile, keys, chains, counts, block_points, block_seen, before, grids
):
    """Distance (m) from every cell's centre to the nearest point of that cell seen by then, at most `clip`.

    places (frame, 3) and yaws (rad) of the device; the box of half edge `half` has its centre `below` under it. A frame
    that is not finite has no points. grids (frame, cells, cells, cells) is filled.
    """
    cells = grids.shape[1]
    edge = 2.0 * half / cells
    nothing = np.float32((clip / edge) ** 2)
    squares = np.empty((cells + 2) ** 3, np.float32)
    cell, square, frame_of = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.float32), np.empty(5, np.float32)
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
                        slot = place_of(keys, tile_key(ix, iy, iz))
                        block = chains[slot] if keys[slot] != FREE else FREE
                        while block != FREE:
                            _lower(
                                block_points[block],
                                block_seen[block],
                                times[frame],
                                places[frame],
                                frame_of,
                                cells,
                                cell,
                                square,
                                squares,
                            )
                            block = before[block]
        for i in range(cells):
            for j in range(cells):
                first = ((i + 1) * (cells + 2) + j + 1) * (cells + 2) + 1
                for k in range(cells):
                    grids[frame, i, j, k] = min(clip, edge * math.sqrt(squares[first + k]))
