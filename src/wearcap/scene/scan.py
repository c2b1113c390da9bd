"""A scanned scene and its photos, and choosing points of it: in a box, within a brush's radius, along a ray of the view."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.surface import SurfaceIndex

_SPREAD = 0.006
"""Points no further from a ray than this share of their distance (half a degree or so) are under the pointer."""
_DEPTH_M = 0.06
"""Points behind the first one by no more than this lie on the same surface."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A dense cloud of the scene's surfaces (world axes, m), coloured where the scanner had cameras."""

    points: Float32[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"] | None = None

    @cached_property
    def surface(self) -> SurfaceIndex:
        """For nearest points and local planes; built at first use (about 1 s per 5 M points)."""
        return SurfaceIndex.build(self.points)


@dataclass(frozen=True)
class Box:
    """A box that stands upright, turned by `yaw` (rad, counter-clockwise from above); world axes, m."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    """Its whole length, width and height."""
    yaw: float = 0.0

    def contains(self, points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, "point"]:
        """Points inside or on the box."""
        away = points - np.asarray(self.center)
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        along, across = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
        half = np.asarray(self.size) / 2
        return (abs(along) <= half[0]) & (abs(across) <= half[1]) & (abs(away[:, 2]) <= half[2])


class SlicedCloud:
    """Points ordered along x: what is near a place lies in a thin slice, so that millions answer in milliseconds."""

    def __init__(self, points: Float[np.ndarray, "point 3"]):
        self.order = np.argsort(points[:, 0], kind="stable")
        self.points = points[self.order]
        self._x = np.ascontiguousarray(self.points[:, 0])

    def in_box(self, box: Box) -> Int64[np.ndarray, "inside"]:
        """Numbers of the points in a box, ascending."""
        reach_x = (abs(np.cos(box.yaw)) * box.size[0] + abs(np.sin(box.yaw)) * box.size[1]) / 2
        part = self._slice(box.center[0], reach_x)
        return np.sort(self.order[part][box.contains(self.points[part])])

    def in_ball(self, center: Float[np.ndarray, "3"], radius_m: float) -> Int64[np.ndarray, "inside"]:
        """Numbers of the points within a distance of a place, ascending."""
        part = self._slice(float(center[0]), radius_m)
        return np.sort(self.order[part][((self.points[part] - center) ** 2).sum(1) <= radius_m**2])

    def _slice(self, middle: float, reach: float) -> slice:
        # The margin keeps points in that float32 puts just beyond the end.
        low, high = np.searchsorted(self._x, [middle - reach - 1e-4, middle + reach + 1e-4])
        return slice(int(low), int(high))


def first_hit(
    points: Float[np.ndarray, "point 3"],
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    radius_m: float = 0.012,
) -> int | None:
    """Number of the point that a ray meets first (the nearest to the ray on that surface); None where it meets none.

    Points are met as balls of a radius, or as what is under the pointer far away. `direction` need not be a unit
    vector.
    """
    ray = direction / np.linalg.norm(direction)
    away = points - origin
    depth = away @ ray
    aside = np.sqrt(np.maximum((away**2).sum(1) - depth**2, 0.0))
    under = np.flatnonzero((depth > 0.02) & (aside < np.maximum(_SPREAD * depth, radius_m)))
    if not len(under):
        return None
    front = under[depth[under] < depth[under].min() + _DEPTH_M]
    return int(front[aside[front].argmin()])


@dataclass(frozen=True)
class Photo:
    """An image file, its calibrated camera, and the camera's pose in the scene (no batch axes, m)."""

    file: Path
    camera: Camera
    T_world_cam: Rigid
