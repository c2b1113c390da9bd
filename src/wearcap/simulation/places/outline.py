"""Convex outlines seen from above."""

import numpy as np
from jaxtyping import Bool, Float


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
