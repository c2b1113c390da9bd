"""Intersections of the rays of an image's pixels with the faces that are visible in them."""

import math

from wearcap.geometry.compiled import compiled


@compiled
def meet_faces(
    rays,
    slots,
    reach,
    pixel_angle,
    pose,
    index,
    nearness,
    frames,
    sky,
    points,
    face,
    facing,
    footprint,
    distance,
    light,
):
    """Point, face, side (1 front, -1 back), footprint (m) and distance along the ray (m) of every pixel.

    `rays` are unit, in the camera's axes; `slots` are the indices of their samples in the (flat) visibility buffers, -1
    where the lens shows nothing, and `reach` turns that sample's depth into distance along the ray. `frames` are
    `Paint.frames`. A pixel without a face (-1) gets its colour in `light`: black, or the sky's.
    """
    for k in range(len(slots)):
        slot = slots[k]
        face[k], distance[k] = -1, math.inf
        if slot < 0:
            continue
        u, v, w = rays[k, 0], rays[k, 1], rays[k, 2]
        dx = pose[0, 0] * u + pose[0, 1] * v + pose[0, 2] * w
        dy = pose[1, 0] * u + pose[1, 1] * v + pose[1, 2] * w
        dz = pose[2, 0] * u + pose[2, 1] * v + pose[2, 2] * w
        number = index[slot]
        if number < 0:
            rise = min(1.0, max(0.0, 0.5 + 0.8 * dz))
            for channel in range(3):
                light[k, channel] = sky[0, channel] + rise * (sky[1, channel] - sky[0, channel])
            continue
        f = frames[number]
        slope = dx * f[9] + dy * f[10] + dz * f[11]
        above = (pose[0, 3] - f[0]) * f[9] + (pose[1, 3] - f[1]) * f[10] + (pose[2, 3] - f[2]) * f[11]
        # A pixel's ray misses its face by up to a sample at outlines: it stays near the drawn depth.
        near = reach[k] / nearness[slot]
        d = (f[12] - above) / slope if abs(slope) > 1e-9 else near
        d = min(1.08 * near, max(0.92 * near, d))
        points[k, 0], points[k, 1], points[k, 2] = (pose[0, 3] + d * dx, pose[1, 3] + d * dy, pose[2, 3] + d * dz)
        face[k], distance[k], facing[k] = number, d, -1.0 if slope > 0 else 1.0
        footprint[k] = d * pixel_angle / math.sqrt(max(0.12, abs(slope)))
