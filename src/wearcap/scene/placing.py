"""Footprint and floor height of an object cut out of a scan, and likely places of its hinge or slide axis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from wearcap.scene.objects import Freedom

_LAYER_M = 0.02
_AROUND_M = 1.5
_OPEN = (0.0, np.pi / 2)
_PULLED_M = (0.0, 0.4)


@dataclass(frozen=True)
class Footprint:
    """The smallest rectangle around an object seen from above (world axes, m)."""

    center: Float[np.ndarray, "2"]
    long: Float[np.ndarray, "2"]
    """Unit vector along the longer side."""
    half_length: float
    half_width: float

    @property
    def short(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the shorter side, to the left of `long`."""
        return np.array([-self.long[1], self.long[0]])


def footprint(points: Float[np.ndarray, "point 3"]) -> Footprint:
    """The rectangle of least area around points seen from above; one of its sides lies on the convex hull."""
    plan = points[:, :2].astype(np.float64)
    try:
        corners = plan[ConvexHull(plan).vertices]
    except QhullError:  # fewer than three points, or all on one line
        corners = plan
    edges = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edges, axis=1)
    along = edges[length > 0] / length[length > 0, None] if (length > 0).any() else np.array([[1.0, 0.0]])
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    low, high = ((reduce(corners @ along.T, 0), reduce(corners @ across.T, 0)) for reduce in (np.min, np.max))
    sides = np.stack([high[0] - low[0], high[1] - low[1]], 1)
    best = int(sides.prod(1).argmin())
    center = (low[0][best] + high[0][best]) / 2 * along[best] + (low[1][best] + high[1][best]) / 2 * across[best]
    length, width = sides[best]
    long = along[best] if length >= width else across[best]
    return Footprint(center, long, max(length, width) / 2, min(length, width) / 2)


def floor_below(points: Float[np.ndarray, "point 3"], scene: Float[np.ndarray, "other 3"]) -> float:
    """Height (m) of the floor that an object stands on: the lowest strong layer of the scene's points around it.

    Without scene points below it, the object's own lowest point.
    """
    low, high, bottom = points[:, :2].min(0), points[:, :2].max(0), float(points[:, 2].min())
    around = ((scene[:, :2] > low - _AROUND_M) & (scene[:, :2] < high + _AROUND_M)).all(1)
    heights = scene[around & (scene[:, 2] < bottom + 0.05), 2].astype(np.float64)
    if not len(heights):
        return bottom
    first = heights.min()
    layer = ((heights - first) / _LAYER_M).astype(np.int64)
    counts = np.bincount(layer)
    floor = int(np.argmax(counts >= 0.3 * counts.max()))
    return float(np.median(heights[abs(layer - floor) <= 1]))


def hinge_places(points: Float[np.ndarray, "point 3"], floor: float) -> Float[np.ndarray, "place 3"]:
    """Likely hinges of a door or window: middles of its two ends, then its corners, then the middles of its sides."""
    plan = footprint(points)
    ends, sides = plan.half_length * plan.long, plan.half_width * plan.short
    offsets = [-ends, ends, sides - ends, -sides - ends, ends + sides, ends - sides, sides, -sides]
    # A corner of the rectangle may stand far off what is not rectangular: never outside of its extent.
    places = np.clip(plan.center + np.array(offsets), points[:, :2].min(0), points[:, :2].max(0))
    return np.concatenate([places, np.full((len(places), 1), floor)], 1)


def snapped(
    place: Float[np.ndarray, "3"], places: Float[np.ndarray, "place 3"], reach_m: float
) -> Float[np.ndarray, "3"]:
    """The horizontally nearest of some places if it is within reach; else the place itself, at their height."""
    distance = np.linalg.norm(places[:, :2] - place[:2], axis=1)
    if distance.min() <= reach_m:
        return places[distance.argmin()]
    return np.array([place[0], place[1], places[0, 2]])


def usual_freedom(kind: str, points: Float[np.ndarray, "point 3"], floor: float) -> Freedom:
    """Default freedom: a hinge at one end, opening to 90°; a slide of 40 cm across the longer side."""
    if kind == "hinge":
        x, y, z = hinge_places(points, floor)[0].tolist()
        return Freedom("hinge", pivot=(x, y, z), limits=_OPEN)
    if kind == "axis":
        x, y = footprint(points).short.tolist()
        return Freedom("axis", axis=(x, y, 0.0), limits=_PULLED_M)
    return Freedom(kind)
