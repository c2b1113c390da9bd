"""Exact distances from points to a triangle mesh: a tree of boxes over its faces, searched by compiled loops."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from wearcap.errors import WearcapError
from wearcap.geometry.compiled import compiled
from wearcap.geometry.mesh import Mesh

_LEAF = 4
"""Faces in a leaf of the tree."""


class _Tree(NamedTuple):
    """A tree of boxes over triangles (m)."""

    corners: Float64[np.ndarray, "face 3 3"]
    """Ordered by leaf."""
    low: Float64[np.ndarray, "node 3"]
    high: Float64[np.ndarray, "node 3"]
    span: Int64[np.ndarray, "node 3"]
    """First and last + 1 of a node's faces, and its left child (the right one follows it), 0 at leaves."""


@dataclass(frozen=True, eq=False)
class TriangleIndex:
    """A mesh's triangles (m), ready for nearest-point queries. Build it with `TriangleIndex.build`."""

    tree: _Tree

    @classmethod
    def build(cls, vertices: Float64[np.ndarray, "vertex 3"], faces: Int64[np.ndarray, "face 3"]) -> "TriangleIndex":
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
        return cls(_Tree(np.ascontiguousarray(corners[order]), low[:used], high[:used], span[:used]))

    @classmethod
    def of(cls, mesh: Mesh) -> "TriangleIndex":
        """Index of a mesh's triangles; a cloud's points are triangles without extent. Raises WearcapError for NaN."""
        faces = mesh.faces.astype(np.int64)
        if not len(faces):
            faces = np.repeat(np.arange(len(mesh.vertices))[:, None], 3, axis=1)
        return cls.build(mesh.vertices.astype(np.float64), faces)

    def nearest(
        self, queries: Float64[np.ndarray, "query 3"]
    ) -> tuple[Float64[np.ndarray, "query"], Float64[np.ndarray, "query 3"]]:
        """Distance (m) from each point to the surface, and the nearest surface point (NaN for points with NaN)."""
        distance, point = np.empty(len(queries)), np.empty((len(queries), 3))
        _nearest_all(queries, self.tree, distance, point)
        return distance, point


@dataclass(frozen=True, eq=False)
class BodiesIndex:
    """Index of several rigidly moving meshes for nearest-body queries. Build it with `BodiesIndex.build`."""

    tree: _Tree
    roots: Int64[np.ndarray, "body"]
    """First node of each body's tree; bodies of one shape share it."""

    @classmethod
    def build(cls, shapes: Sequence[TriangleIndex], shape_of_body: Int64[np.ndarray, "body"]) -> "BodiesIndex":
        """Join the shapes' trees. Raises ValueError without a shape."""
        trees = [shape.tree for shape in shapes]
        first_face = np.cumsum([0, *(len(tree.corners) for tree in trees)])
        first_node = np.cumsum([0, *(len(tree.span) for tree in trees)])
        spans = []
        for tree, face, node in zip(trees, first_face, first_node):
            child = np.where(tree.span[:, 2:] > 0, tree.span[:, 2:] + node, 0)
            spans.append(np.concatenate([tree.span[:, :2] + face, child], 1))
        corners, low, high, _ = (np.concatenate(part) for part in zip(*trees))
        return cls(_Tree(corners, low, high, np.concatenate(spans)), first_node[shape_of_body])

    def nearest(
        self,
        queries: Float64[np.ndarray, "query 3"],
        bodies: Int64[np.ndarray, "chosen"],
        R_world_body: Float64[np.ndarray, "chosen 3 3"],
        t_world_body: Float64[np.ndarray, "chosen 3"],
        reach_m: float,
    ) -> tuple[Int64[np.ndarray, "query"], Float64[np.ndarray, "query"]]:
        """For each point the nearest of the chosen bodies (its number among all) and the distance (m); -1 and infinity
        where none is nearer than `reach_m`."""
        body, distance = np.empty(len(queries), np.int64), np.empty(len(queries))
        _nearest_bodies(queries, R_world_body, t_world_body, self.roots[bodies], reach_m, self.tree, body, distance)
        return np.append(bodies, -1)[body], distance


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
def _segment_nearest(px, py, pz, ux, uy, uz):
    """Squared distance from p to the segment from the origin to u, and the share of u that is nearest."""
    length = ux * ux + uy * uy + uz * uz
    share = 0.0
    if length > 0:
        share = min(max((px * ux + py * uy + pz * uz) / length, 0.0), 1.0)
    dx, dy, dz = px - share * ux, py - share * uy, pz - share * uz
    return dx * dx + dy * dy + dz * dz, share


@compiled
def _triangle_nearest(p, triangle):
    """Squared distance from p to a triangle (a, a + u, a + v), and s, t of the nearest point a + s·u + t·v.

    It lies in the plane above the inside, else on the nearest side.
    """
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
            return dx * dx + dy * dy + dz * dz, s, t
    first, along_u = _segment_nearest(px, py, pz, ux, uy, uz)
    second, along_v = _segment_nearest(px, py, pz, vx, vy, vz)
    third, across = _segment_nearest(px - ux, py - uy, pz - uz, vx - ux, vy - uy, vz - uz)
    if first <= second and first <= third:
        return first, along_u, 0.0
    if second <= third:
        return second, 0.0, along_v
    return third, 1.0 - across, across


@compiled
def _nearest_face(p, root, best, tree, stack, reach):
    """(squared distance, row in `corners`) of the face nearest to p below a node; (best, -1) where none is nearer."""
    corners, low, high, span = tree
    found = -1
    depth, stack[0], reach[0] = 1, root, _box_distance(p, low[root], high[root])
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if reach[depth] >= best:
            continue
        child = span[node, 2]
        if child == 0:
            for i in range(span[node, 0], span[node, 1]):
                square, _, _ = _triangle_nearest(p, corners[i])
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
    return best, found


@compiled
def _nearest_all(queries, tree, distance, point):
    """Neighbouring queries are often near each other, as along a path: the last one's face bounds the search."""
    corners = tree.corners
    stack, reach = np.empty(128, np.int64), np.empty(128)
    last = 0
    for q in range(len(queries)):
        p = queries[q]
        if not (np.isfinite(p[0]) and np.isfinite(p[1]) and np.isfinite(p[2])):
            distance[q], point[q] = np.nan, np.nan
            continue
        best, _, _ = _triangle_nearest(p, corners[last])
        best, found = _nearest_face(p, 0, best, tree, stack, reach)
        last = found if found >= 0 else last
        _, s, t = _triangle_nearest(p, corners[last])
        distance[q] = np.sqrt(best)
        for axis in range(3):
            a = corners[last, 0, axis]
            point[q, axis] = a + s * (corners[last, 1, axis] - a) + t * (corners[last, 2, axis] - a)


@compiled
def _nearest_bodies(queries, R, t, roots, reach_m, tree, body, distance):
    """Every body's box bounds its distance; the nearest box is searched first, the others only while they can win."""
    _, low, high, _ = tree
    stack, reach = np.empty(128, np.int64), np.empty(128)
    bound, local = np.empty(len(roots)), np.empty((len(roots), 3))
    for q in range(len(queries)):
        body[q], distance[q] = -1, np.inf
        first = -1
        for k in range(len(roots)):
            dx, dy, dz = queries[q, 0] - t[k, 0], queries[q, 1] - t[k, 1], queries[q, 2] - t[k, 2]
            for axis in range(3):
                local[k, axis] = R[k, 0, axis] * dx + R[k, 1, axis] * dy + R[k, 2, axis] * dz
            bound[k] = _box_distance(local[k], low[roots[k]], high[roots[k]])
            if first < 0 or bound[k] < bound[first]:
                first = k
        if first < 0 or not np.isfinite(queries[q, 0] + queries[q, 1] + queries[q, 2]):
            continue
        best = reach_m * reach_m
        for turn in range(-1, len(roots)):
            k = first if turn < 0 else turn
            if bound[k] >= best or turn == first:
                continue
            square, found = _nearest_face(local[k], roots[k], best, tree, stack, reach)
            if found >= 0:
                best, body[q], distance[q] = square, k, np.sqrt(square)
