"""Exact distances from points to a triangle mesh: a tree of boxes over its faces, searched by compiled loops."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from wearcap.errors import WearcapError
from wearcap.geometry.compiled import compiled

_LEAF = 4
"""Faces in a leaf of the tree."""


@dataclass(frozen=True, eq=False)
class TriangleIndex:
    """A mesh's triangles (m), ready for nearest-point queries. Build it with `TriangleIndex.build`."""

    corners: Float64[np.ndarray, "face 3 3"]
    """Ordered by leaf."""
    order: Int64[np.ndarray, "face"]
    """Number in the mesh of each of `corners`."""
    low: Float64[np.ndarray, "node 3"]
    high: Float64[np.ndarray, "node 3"]
    span: Int64[np.ndarray, "node 3"]
    """First and last + 1 of a node's faces, and its left child (the right one follows it), 0 at leaves."""

    @classmethod
    def build(
        cls, vertices: Float64[np.ndarray, "vertex 3"], faces: Int64[np.ndarray, "face 3"]
    ) -> "TriangleIndex":
        """Halve the faces along their boxes' longest sides. Raises WearcapError without faces or with NaN."""
        if not len(faces):
            raise WearcapError("a mesh without faces has no surface", expected="at least one triangle")
        if not np.isfinite(vertices).all():
            raise WearcapError("the mesh's vertices are NaN or infinite", expected="finite coordinates (m)")
        corners = vertices[faces]
        nodes = 2 * len(faces)
        low, high, span = np.empty((nodes, 3)), np.empty((nodes, 3)), np.zeros((nodes, 3), np.int64)
        order = np.arange(len(faces))
        used = _build(corners.mean(1), corners.min(1), corners.max(1), order, low, high, span)
        return cls(np.ascontiguousarray(corners[order]), order, low[:used], high[:used], span[:used])

    def nearest(
        self, queries: Float64[np.ndarray, "query 3"]
    ) -> tuple[Float64[np.ndarray, "query"], Int64[np.ndarray, "query"]]:
        """Distance (m) from each point to the surface, and the face that is nearest."""
        distance, face = np.empty(len(queries)), np.empty(len(queries), np.int64)
        _nearest_all(queries, self.corners, self.low, self.high, self.span, distance, face)
        return distance, self.order[face]


@compiled
def _build(centers, face_low, face_high, order, low, high, span):
    """Fill the nodes and sort `order` by leaf; returns how many nodes there are."""
    span[0, 0], span[0, 1] = 0, len(order)
    used, node = 1, 0
    while node < used:
        start, stop = span[node, 0], span[node, 1]
        spread_low, spread_high = np.full(3, np.inf), np.full(3, -np.inf)
        for axis in range(3):
            low[node, axis], high[node, axis] = np.inf, -np.inf
            for i in range(start, stop):
                face = order[i]
                low[node, axis] = min(low[node, axis], face_low[face, axis])
                high[node, axis] = max(high[node, axis], face_high[face, axis])
                spread_low[axis] = min(spread_low[axis], centers[face, axis])
                spread_high[axis] = max(spread_high[axis], centers[face, axis])
        if stop - start > _LEAF:
            axis = np.argmax(spread_high - spread_low)
            part = order[start:stop].copy()
            order[start:stop] = part[np.argsort(centers[part, axis], kind="mergesort")]
            middle = (start + stop) // 2
            span[node, 2] = used
            span[used, 0], span[used, 1] = start, middle
            span[used + 1, 0], span[used + 1, 1] = middle, stop
            used += 2
        node += 1
    return used


@compiled
def _box_distance(p, low, high):
    """Squared distance from a point to a box, 0 inside."""
    total = 0.0
    for axis in range(3):
        gap = max(low[axis] - p[axis], 0.0, p[axis] - high[axis])
        total += gap * gap
    return total


@compiled
def _segment_distance(px, py, pz, ux, uy, uz):
    """Squared distance from p to the segment from the origin to u."""
    length = ux * ux + uy * uy + uz * uz
    share = 0.0
    if length > 0:
        share = min(max((px * ux + py * uy + pz * uz) / length, 0.0), 1.0)
    dx, dy, dz = px - share * ux, py - share * uy, pz - share * uz
    return dx * dx + dy * dy + dz * dz


@compiled
def _triangle_distance(p, triangle):
    """Squared distance from a point to a triangle: to its plane above the inside, else to the nearest side."""
    px, py, pz = p[0] - triangle[0, 0], p[1] - triangle[0, 1], p[2] - triangle[0, 2]
    ux, uy, uz = (
        triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    )  # fmt: skip
    vx, vy, vz = (
        triangle[2, 0] - triangle[0, 0], triangle[2, 1] - triangle[0, 1], triangle[2, 2] - triangle[0, 2]
    )  # fmt: skip
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    pu, pv = px * ux + py * uy + pz * uz, px * vx + py * vy + pz * vz
    area = uu * vv - uv * uv
    if area > 1e-12 * uu * vv:
        s, t = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
        if s >= 0 and t >= 0 and s + t <= 1:
            dx, dy, dz = px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz
            return dx * dx + dy * dy + dz * dz
    first = _segment_distance(px, py, pz, ux, uy, uz)
    second = _segment_distance(px, py, pz, vx, vy, vz)
    third = _segment_distance(px - ux, py - uy, pz - uz, vx - ux, vy - uy, vz - uz)
    return min(first, second, third)


@compiled
def _nearest_all(queries, corners, low, high, span, distance, face):
    stack, reach = np.empty(128, np.int64), np.empty(128)
    for q in range(len(queries)):
        p = queries[q]
        best, found = np.inf, -1
        depth, stack[0], reach[0] = 1, 0, 0.0
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if reach[depth] >= best:
                continue
            child = span[node, 2]
            if child == 0:
                for i in range(span[node, 0], span[node, 1]):
                    square = _triangle_distance(p, corners[i])
                    if square < best:
                        best, found = square, i
                continue
            near, far = child, child + 1
            near_reach = _box_distance(p, low[near], high[near])
            far_reach = _box_distance(p, low[far], high[far])
            if far_reach < near_reach:
                near, far, near_reach, far_reach = far, near, far_reach, near_reach
            stack[depth], reach[depth] = far, far_reach
            stack[depth + 1], reach[depth + 1] = near, near_reach
            depth += 2
        distance[q], face[q] = np.sqrt(best), found
