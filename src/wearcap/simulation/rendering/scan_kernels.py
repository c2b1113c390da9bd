"""Visibility of a world's surface samples from a scanner's stations, and their measurement."""

import math

from wearcap.geometry.compiled import compiled


@compiled
def cube_pixel(x, y, z, size):
    """Side of the cube around a station, row and column, and depth before that side, of an offset from it."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if az >= ax and az >= ay:
        side, depth = (0 if z > 0 else 5), az
        u, v = (x if z > 0 else -x), y
    elif ax >= ay:
        side, depth = (1 if x > 0 else 2), ax
        u, v = (-z if x > 0 else z), y
    else:
        side, depth = (3 if y > 0 else 4), ay
        u, v = x, (-z if y > 0 else z)
    depth = max(depth, 1e-6)
    column = int(min(size - 1.0, max(0.0, math.floor(0.5 * size * (1.0 + u / depth)))))
    row = int(min(size - 1.0, max(0.0, math.floor(0.5 * size * (1.0 + v / depth)))))
    return side, row, column, depth


@compiled
def measure(
    points,
    normals,
    stations,
    near_stations,
    near_first,
    cell,
    origin,
    shape,
    nearness,
    luck,
    full_m,
    max_m,
    noise_m,
    mixed,
    wrong,
    draws,
    out,
    kept,
):
    """Measured position of every point that a station sees; `kept` is their mask.

    The stations of a point's cell are tried from near to far; `nearness` is 1/depth (station side row column).
    Beyond `full_m` fewer points are met. Range noise, range errors and points that float between an outline and
    what lies behind it lie along the ray. `luck` (point 3) is uniform and `draws` (point) normal.
    """
    size = nearness.shape[-1]
    for k in range(len(points)):
        kept[k] = False
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        i, j = int((x - origin[0]) / cell), int((y - origin[1]) / cell)
        if i < 0 or j < 0 or i >= shape[0] or j >= shape[1]:
            continue
        slot = i * shape[1] + j
        for n in range(near_first[slot], near_first[slot + 1]):
            station = near_stations[n]
            dx, dy, dz = x - stations[station, 0], y - stations[station, 1], z - stations[station, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            facing = -(dx * normals[k, 0] + dy * normals[k, 1] + dz * normals[k, 2]) / distance
            if distance > max_m or distance < 0.3 or facing < 0.03:
                continue
            side, row, column, depth = cube_pixel(dx, dy, dz, size)
            drawn = nearness[station, side, row, column]
            if drawn * depth > 1.02 + 0.08 * (1.0 - min(1.0, 4.0 * facing)):
                continue
            if luck[k, 0] * max(1.0, (distance / full_m) ** 2) > min(1.0, 2.5 * facing):
                break
            stretch = noise_m * draws[k] / distance
            if luck[k, 1] < wrong:
                stretch = -0.5 * luck[k, 2]
            elif luck[k, 1] < wrong + mixed:
                beyond = max(
                    nearness[station, side, row, min(size - 1, column + 1)],
                    nearness[station, side, row, max(0, column - 1)],
                )
                if beyond * depth > 1.15:
                    stretch = luck[k, 2] * (1.0 / (beyond * depth) - 1.0)
            out[k, 0], out[k, 1], out[k, 2] = x + stretch * dx, y + stretch * dy, z + stretch * dz
            kept[k] = True
            break
