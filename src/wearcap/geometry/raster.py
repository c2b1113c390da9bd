"""Pixel loops of the renderer: which triangle or splat is nearest in each pixel, and its shaded colour.

The z-buffer holds nearness, which grows towards the camera: 1/depth for perspective (linear on the screen for
a plane, so that interpolating it is exact), the height towards the light for orthographic maps.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from wearcap.geometry.compiled import compiled


class Triangles(NamedTuple):
    """Arrays of all triangles of a picture; vertices and normals in the camera's axes where they are shaded."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    """Of each vertex, float32."""
    smooth: np.ndarray
    """Whether a face is shaded with its vertices' normals."""
    casts: np.ndarray
    """Whether a face casts shadows."""
    colors: np.ndarray
    """Table of RGB 0…255, float32."""
    color_rows: np.ndarray
    """Row of the table for each corner of each face."""


class Shadows(NamedTuple):
    """Height maps of what casts shadows: towards the key light and from below. Empty maps cast none."""

    axes: np.ndarray = np.zeros((6, 4))
    """Rows of the two maps: right, up, towards the viewer, each with its offset."""
    scale: float = 1.0
    """Texels per metre."""
    nearest: np.ndarray = np.zeros((0, 0), np.float32)
    high: np.ndarray = np.zeros((0, 0), np.float32)
    low: np.ndarray = np.zeros((0, 0), np.float32)
    """Extremes of `nearest` over the 4 x 4 texels of a query, which decide most pixels at once."""
    contact: np.ndarray = np.zeros((0, 0), np.float32)
    """exp(height / fade) of the surfaces seen from below, blurred."""
    fade: float = 1.0
    """Height (m) over which a contact shade loses 63 % of its strength."""


def empty_buffers(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Nearness and index of a picture in which nothing is drawn yet."""
    return np.full((height, width), -np.inf, np.float32), np.full((height, width), -1, np.int32)


@compiled
def _fill_triangle(a, b, c, number, nearness, index):
    """Draw one triangle given by its corners (x and y in pixels, nearness w)."""
    x0, y0, w0 = a
    x1, y1, w1 = b
    x2, y2, w2 = c
    height, width = nearness.shape
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if not abs(area) > 1e-12:
        return
    dw_dx = ((w1 - w0) * (y2 - y0) - (w2 - w0) * (y1 - y0)) / area
    dw_dy = ((w2 - w0) * (x1 - x0) - (w1 - w0) * (x2 - x0)) / area
    highest = max(w0, w1, w2)
    lowest = min(w0, w1, w2)
    sign = 1.0 if area > 0 else -1.0
    top = max(0, math.ceil(min(y0, y1, y2)))
    bottom = min(height - 1, math.floor(max(y0, y1, y2)))
    for y in range(top, bottom + 1):
        low, high = 0.0, width - 1.0
        for xa, ya, xb, yb in ((x0, y0, x1, y1), (x1, y1, x2, y2), (x2, y2, x0, y0)):
            # the pixel is inside this edge where slope * x + rest >= 0
            slope = -sign * (yb - ya)
            rest = sign * ((xb - xa) * y + (xa * yb - xb * ya))
            if slope > 0:
                low = max(low, -rest / slope)
            elif slope < 0:
                high = min(high, -rest / slope)
            elif rest < 0:
                high = -1.0
        for x in range(math.ceil(low), math.floor(high) + 1):
            w = min(highest, max(lowest, w0 + (x - x0) * dw_dx + (y - y0) * dw_dy))
            if w > nearness[y, x]:
                nearness[y, x] = w
                index[y, x] = number


@compiled
def draw_pinhole(vertices, faces, fx, fy, cx, cy, near, nearness, index):
    """Triangles with corners in the camera's axes, clipped at the plane z = near."""
    corners = [(0.0, 0.0, 0.0)] * 4
    for number in range(len(faces)):
        count = 0
        for corner in range(3):
            a, b = faces[number, corner], faces[number, (corner + 1) % 3]
            za, zb = vertices[a, 2], vertices[b, 2]
            if za >= near:
                corners[count] = (fx * vertices[a, 0] / za + cx, fy * vertices[a, 1] / za + cy, 1.0 / za)
                count += 1
            if (za >= near) != (zb >= near):
                blend = (near - za) / (zb - za)
                x = fx * (vertices[a, 0] + blend * (vertices[b, 0] - vertices[a, 0])) / near + cx
                y = fy * (vertices[a, 1] + blend * (vertices[b, 1] - vertices[a, 1])) / near + cy
                corners[count] = (x, y, 1.0 / near)
                count += 1
        for last in range(2, count):
            _fill_triangle(corners[0], corners[last - 1], corners[last], number, nearness, index)


@compiled
def draw_projected(pixels, near, valid, faces, nearness, index):
    """Triangles whose corners are already pixels of nearness `near`; none with a corner that is not valid."""
    for number in range(len(faces)):
        a, b, c = faces[number, 0], faces[number, 1], faces[number, 2]
        if valid[a] and valid[b] and valid[c]:
            first = (pixels[a, 0], pixels[a, 1], near[a])
            second = (pixels[b, 0], pixels[b, 1], near[b])
            third = (pixels[c, 0], pixels[c, 1], near[c])
            _fill_triangle(first, second, third, number, nearness, index)


_BULGE = 4.0
"""Depth of a splat's rim behind its centre, in radii; at a slant of 45° a point's image then shifts by 1/8 radius."""


@compiled
def _project_point(x, y, z, lens):
    """Pixel of a point in camera axes, and its nearness: 1/z, for fisheyes 1/distance; 0 if not visible.

    `lens` is laid out as in `geometry.render.lens_numbers`. Pixels may be outside the image.
    """
    square = x * x + y * y
    if lens[0] == 0.0:  # plane coordinates x/z, y/z
        if z < lens[5]:
            return 0.0, 0.0, 0.0
        scale = nearness = 1.0 / z
        s = square * nearness * nearness
    else:  # the angle from the axis, along (x, y)
        distance = math.sqrt(square + z * z)
        if distance < lens[5]:
            return 0.0, 0.0, 0.0
        nearness = 1.0 / distance
        radius = math.sqrt(square)
        if radius < 1e-9 * distance:
            if z < 0:
                return 0.0, 0.0, 0.0
            scale, s = 1.0 / z, 0.0
        else:
            theta = math.atan2(radius, z)
            scale, s = theta / radius, theta * theta
    if s >= lens[6]:
        return 0.0, 0.0, 0.0
    u, v = x * scale, y * scale
    count = int(lens[7])
    if count > 0:
        argument = s if lens[8] == 0.0 else math.sqrt(s)
        gain = 0.0
        for k in range(count, 0, -1):
            gain = (gain + lens[18 + k]) * argument
        bent_u, bent_v = u * (1.0 + gain), v * (1.0 + gain)
        base_u, base_v = (bent_u, bent_v) if lens[9] == 0.0 else (u, v)
        base = base_u * base_u + base_v * base_v
        along = 2.0 * (base_u * lens[10] + base_v * lens[11])
        bent = bent_u * bent_u + bent_v * bent_v
        u = bent_u + along * base_u + base * lens[10] + (lens[12] + lens[13] * bent) * bent
        v = bent_v + along * base_v + base * lens[11] + (lens[14] + lens[15] * bent) * bent
        u, v = u + lens[16] * v, lens[17] * u + lens[18] * v
    return lens[1] * u + lens[3], lens[2] * v + lens[4], nearness


@compiled
def _disc(x, y, r, w, bulge, number, nearness, index):
    """One disc of r pixels that faces the camera; it always covers the pixel nearest to its centre.

    Its nearness falls by `bulge` times the square of the distance (pixels) from its centre.
    """
    height, width = nearness.shape
    column, row = math.floor(x + 0.5), math.floor(y + 0.5)
    if 0 <= column < width and 0 <= row < height:
        near = w - bulge * min((column - x) ** 2 + (row - y) ** 2, r * r)
        if near > nearness[row, column]:
            nearness[row, column] = near
            index[row, column] = number
    for v in range(max(0, math.ceil(y - r)), min(height - 1, math.floor(y + r)) + 1):
        beside = (v - y) ** 2
        reach = math.sqrt(max(0.0, r * r - beside))
        for u in range(max(0, math.ceil(x - reach)), min(width - 1, math.floor(x + reach)) + 1):
            near = w - bulge * ((u - x) ** 2 + beside)
            if near > nearness[v, u]:
                nearness[v, u] = near
                index[v, u] = number


@compiled
def draw_splats(blocks, pose, planes, lens, radius, metric, offset, nearness, index):
    """Project points, block by block, and draw those that the camera sees as discs.

    `blocks`: points, first, centers, radii. Block b holds points first[b] … first[b + 1] - 1 within `radii[b]` of
    `centers[b]`; one that lies beyond one of `planes` (inward normal in the camera's axes) is passed over. `pose`: [R_cam_world | t_cam_world].
    `radius`: in metres where `metric`, else in pixels. Discs of metres are paraboloids whose rims lie `_BULGE` radii
    behind their centres: on a slanted surface the disc in front would else hide its neighbour, and what is painted
    there would seem shifted. Returns the number of points that were projected.
    """
    points, first, centers, radii = blocks
    height, width = nearness.shape
    focal = 0.5 * (lens[1] + lens[2])
    bulge = _BULGE / (radius * focal * focal) if metric else 0.0
    projected = 0
    for block in range(len(first) - 1):
        outside = False
        for plane in range(len(planes)):
            depth = 0.0
            for row in range(3):
                depth += planes[plane, row] * (
                    pose[row, 0] * centers[block, 0]
                    + pose[row, 1] * centers[block, 1]
                    + pose[row, 2] * centers[block, 2]
                    + pose[row, 3]
                )
            outside = outside or depth < -radii[block]
        if outside:
            continue
        projected += first[block + 1] - first[block]
        for number in range(first[block], first[block + 1]):
            px, py, pz = float(points[number, 0]), float(points[number, 1]), float(points[number, 2])
            x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
            y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            u, v, w = _project_point(x, y, z, lens)
            if w > 0 and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5:
                _disc(u, v, radius * focal * w if metric else radius, w, bulge, offset + number, nearness, index)
    return projected


@partial(compiled, inline="always")
def _hit(rx, ry, rz, a, b, c, vertices, normals, smooth):
    """Where the ray through the camera's centre meets a triangle: barycentric weights of corners b and c, and the unit
    normal, the triangle's or between its corners', on the side that the ray meets: that side is lit."""
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    px, py, pz = ry * vz - rz * vy, rz * vx - rx * vz, rx * vy - ry * vx
    det = ux * px + uy * py + uz * pz
    second, third = 0.0, 0.0
    if not abs(det) < 1e-20:
        qx, qy, qz = -ay * uz + az * uy, -az * ux + ax * uz, -ax * uy + ay * ux
        second = min(1.0, max(0.0, -(ax * px + ay * py + az * pz) / det))
        third = min(1.0 - second, max(0.0, (rx * qx + ry * qy + rz * qz) / det))
    if smooth:
        first = 1.0 - second - third
        nx = first * normals[a, 0] + second * normals[b, 0] + third * normals[c, 0]
        ny = first * normals[a, 1] + second * normals[b, 1] + third * normals[c, 1]
        nz = first * normals[a, 2] + second * normals[b, 2] + third * normals[c, 2]
    else:
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-30
    if nx * rx + ny * ry + nz * rz > 0:
        length = -length
    return second, third, nx / length, ny / length, nz / length


@partial(compiled, inline="always")
def _key_visibility(x, y, z, axes, scale, shadow, high, low):
    """Part (0…1) of the key light that reaches a point: percentage-closer filtering over 4 x 4 texels."""
    size = len(shadow)
    u = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z + axes[0, 3]) * scale
    v = (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z + axes[1, 3]) * scale
    d = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z + axes[2, 3] + 0.004
    column, row = math.floor(u), math.floor(v)
    if column < 2 or row < 2 or column > size - 4 or row > size - 4:
        return 1.0
    if high[row, column] <= d:
        return 1.0
    if low[row, column] > d:
        return 0.0
    du, dv, lit = u - column, v - row, 0.0
    for i in range(-1, 3):
        wi = (1 - dv) if i == -1 else (dv if i == 2 else 1.0)
        for j in range(-1, 3):
            wj = (1 - du) if j == -1 else (du if j == 2 else 1.0)
            if shadow[row + i, column + j] <= d:
                lit += wi * wj
    return lit / 9.0


@partial(compiled, inline="always")
def _contact_shade(x, y, z, axes, scale, contact, fade):
    """Fraction (0…1) of the sky occluded by geometry close above an upward surface: largest where they touch."""
    u = (axes[3, 0] * x + axes[3, 1] * y + axes[3, 2] * z + axes[3, 3]) * scale
    v = (axes[4, 0] * x + axes[4, 1] * y + axes[4, 2] * z + axes[4, 3]) * scale
    height = axes[5, 0] * x + axes[5, 1] * y + axes[5, 2] * z + axes[5, 3]
    column, row = math.floor(u), math.floor(v)
    if column < 0 or row < 0 or column > len(contact) - 2 or row > len(contact) - 2:
        return 0.0
    du, dv = u - column, v - row
    value = (1 - dv) * ((1 - du) * contact[row, column] + du * contact[row, column + 1])
    value += dv * ((1 - du) * contact[row + 1, column] + du * contact[row + 1, column + 1])
    return min(1.0, value * math.exp(min(80.0, -height / fade)))


@compiled
def resolve(
    nearness, index, rays, samples, pose, scene, point_colors, light, shadows, background, color, depth, number
):
    """Shade the visible samples and average `samples` x `samples` of them into each pixel of the picture.

    `scene`: `Triangles`; `shadows`: `Shadows`; `light`: direction to the key light (3), its strength, the ambient light
    from below and from above. A pixel's depth and number are those of its nearest sample.
    """
    vertices, faces, normals, smooth, casts, colors, color_rows = scene
    axes, scale, shadow, high, low, contact, fade = shadows
    total, rgb = samples * samples, np.empty(3)
    for row in range(color.shape[0]):
        for column in range(color.shape[1]):
            rgb[:] = 0.0
            best, best_number = 0.0, -1
            for sample in range(total):
                v, u = row * samples + sample // samples, column * samples + sample % samples
                face, w = index[v, u], nearness[v, u]
                if face >= 0 and w > best:
                    best, best_number = w, face
                if face < 0 or face >= len(faces):
                    for k in range(3):
                        rgb[k] += background[row, k] if face < 0 else point_colors[face - len(faces), k]
                    continue
                rx, ry, rz = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                second, third, nx, ny, nz = _hit(rx, ry, rz, a, b, c, vertices, normals, smooth[face])
                first = 1.0 - second - third
                wx = pose[0, 0] * nx + pose[0, 1] * ny + pose[0, 2] * nz
                wy = pose[1, 0] * nx + pose[1, 1] * ny + pose[1, 2] * nz
                wz = pose[2, 0] * nx + pose[2, 1] * ny + pose[2, 2] * nz
                key = light[3] * max(0.0, wx * light[0] + wy * light[1] + wz * light[2])
                ambient = light[4] + (light[5] - light[4]) * (0.5 + 0.5 * wz)
                if len(shadow) > 0:
                    z = 1.0 / w
                    x = pose[0, 0] * rx * z + pose[0, 1] * ry * z + pose[0, 2] * rz * z + pose[0, 3]
                    y = pose[1, 0] * rx * z + pose[1, 1] * ry * z + pose[1, 2] * rz * z + pose[1, 3]
                    z = pose[2, 0] * rx * z + pose[2, 1] * ry * z + pose[2, 2] * rz * z + pose[2, 3]
                    if key > 0:
                        out_x, out_y, out_z = x + 0.015 * wx, y + 0.015 * wy, z + 0.015 * wz
                        key *= _key_visibility(out_x, out_y, out_z, axes, scale, shadow, high, low)
                    if wz > 0.3 and not casts[face]:
                        hidden = _contact_shade(x, y, z, axes, scale, contact, fade)
                        ambient *= 1.0 - 0.75 * hidden
                        key *= 1.0 - 0.5 * hidden
                ra, rb, rc = color_rows[face, 0], color_rows[face, 1], color_rows[face, 2]
                shade = ambient + key
                for k in range(3):
                    rgb[k] += shade * (first * colors[ra, k] + second * colors[rb, k] + third * colors[rc, k])
            for k in range(3):
                color[row, column, k] = min(255.0, rgb[k] / total + 0.5)
            depth[row, column] = 1.0 / best if best_number >= 0 else math.inf
            number[row, column] = best_number
