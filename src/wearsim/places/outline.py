"""Outlines seen from above: convex polygons, and boxes along a builder's axes."""

import numpy as np
from jaxtyping import Bool, Float

Box = tuple[float, float, float, float]
"""x_low, y_low, x_high, y_high (m), along the builder's axes."""


def rectangle(center: tuple[float, float], size: tuple[float, float], heading: float = 0.0) -> Float[np.ndarray, "4 2"]:
    """Counter-clockwise corners of a rectangle, `size` along and across its heading (m)."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * np.array(size) / 2
    return corners @ turn(heading).T + np.array(center)


def turn(heading: float) -> Float[np.ndarray, "2 2"]:
    """Rotation matrix in the plane."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, -sin], [sin, cos]])


def points_in_convex(
    points_xy: Float[np.ndarray, "point 2"], polygon: Float[np.ndarray, "corner 2"]
) -> Bool[np.ndarray, "point"]:
    """Whether points lie in a convex counter-clockwise polygon, its border included."""
    low, high = polygon.min(0) - 1e-9, polygon.max(0) + 1e-9
    x, y = points_xy[:, 0], points_xy[:, 1]
    inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    candidates = np.nonzero(inside)[0]
    x, y = x[candidates], y[candidates]
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0)):
        edge = end - start
        outside = edge[0] * (y - start[1]) - edge[1] * (x - start[0]) < -1e-9
        inside[candidates[outside]] = False
    return inside


def distance_to_convex(
    points_xy: Float[np.ndarray, "*batch 2"], polygon: Float[np.ndarray, "corner 2"]
) -> Float[np.ndarray, "*batch"]:
    """Distance (m) from points to a convex counter-clockwise polygon; 0 inside."""
    best = np.full(points_xy.shape[:-1], np.inf)
    inside = np.ones(points_xy.shape[:-1], bool)
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0)):
        edge, offset = end - start, points_xy - start
        share = np.clip((offset @ edge) / (edge @ edge), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(offset - share[..., None] * edge, axis=-1))
        inside &= edge[0] * offset[..., 1] - edge[1] * offset[..., 0] >= 0
    return np.where(inside, 0.0, best)


def middle_and_size(box: Box) -> tuple[tuple[float, float], tuple[float, float]]:
    """Middle and size of a box (m)."""
    return ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), (box[2] - box[0], box[3] - box[1])


def inset(box: Box, margin: float) -> Box:
    """The box without a margin on all sides (m)."""
    return (box[0] + margin, box[1] + margin, box[2] - margin, box[3] - margin)


def overlaps(a: Box, b: Box, margin: float = 0.0) -> bool:
    """Whether two boxes overlap or are nearer to each other than a margin (m)."""
    apart = a[0] >= b[2] + margin or b[0] >= a[2] + margin or a[1] >= b[3] + margin or b[1] >= a[3] + margin
    return not apart


def around(points: Float[np.ndarray, "point 2"]) -> Box:
    """The smallest box around points (m)."""
    low, high = points.min(0), points.max(0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def stays_apart(
    outline: Float[np.ndarray, "4 2"],
    places: Float[np.ndarray, "key 3"],
    others: list[Float[np.ndarray, "corner 2"]],
    least_m: float,
) -> bool:
    """Whether an outline at places x, y (m), heading (rad) keeps a distance from others.

    Neither's border comes near the other.
    """
    share = np.linspace(0.0, 1.0, 7)[:-1, None]

    def border(corners: Float[np.ndarray, "corner 2"]) -> Float[np.ndarray, "point 2"]:
        return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0))])

    outlines = np.stack([outline @ turn(heading).T + np.array([x, y]) for x, y, heading in places])
    points = np.concatenate([border(corners) for corners in outlines])
    low, high = points.min(0) - least_m, points.max(0) + least_m
    for other in others:
        if (other.min(0) > high).any() or (other.max(0) < low).any():
            continue
        if distance_to_convex(points, other).min() <= least_m:
            return False
        rim = border(other)
        if min(distance_to_convex(rim, corners).min() for corners in outlines) <= least_m:
            return False
    return True
