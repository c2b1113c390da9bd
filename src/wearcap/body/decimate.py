"""Mesh decimation by quadric error: vertices collapse onto neighbours where the surface changes least."""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse


def decimate(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    keep: int,
    importance: Float[np.ndarray, "vertex"] | None = None,
) -> tuple[Int[np.ndarray, "kept"], Int[np.ndarray, "face_kept 3"]]:
    """Indices of the vertices that remain, and the new faces, which index into them.

    Half-edge collapses by quadric error (Garland & Heckbert 1997) times `importance`: vertices keep their
    places, so whatever is stored per vertex stays valid for those kept. Each pass takes the cheapest collapses
    that are three edges apart, all at once. Rims of open meshes stay; stops early where nothing may fall.
    """
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    importance = np.ones(len(vertices)) if importance is None else importance
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(area, 1e-20)
    plane = np.concatenate([normal, -(normal * a).sum(1, keepdims=True)], 1)
    outer = plane[:, :, None] * plane[:, None, :] * area[:, :, None]
    quadric = np.zeros((len(vertices), 4, 4))  # of the planes of each vertex's faces, weighted by area
    for corner in range(3):
        np.add.at(quadric, faces[:, corner], outer)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    rim = np.zeros(len(vertices), dtype=bool)  # vertices on an edge that has not exactly two faces
    rim[edges[uses != 2].ravel()] = True
    alive = len(np.unique(faces))
    while alive > keep:
        target, cost = _cheapest(vertices, faces, quadric, importance, rim)
        # Vertices cheaper than all others within two edges.
        own = lowest = cost + 1e-15 * np.arange(len(cost))
        for _ in range(2):
            around, wider = lowest[faces].min(1), lowest.copy()
            for corner in range(3):
                np.minimum.at(wider, faces[:, corner], around)
            lowest = wider
        chosen = np.flatnonzero(np.isfinite(own) & (own <= lowest))
        chosen = chosen[np.argsort(cost[chosen])][: alive - keep]
        if not len(chosen):
            break
        moved = np.arange(len(vertices))
        moved[chosen] = target[chosen]
        np.add.at(quadric, target[chosen], quadric[chosen])
        faces = moved[faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        alive -= len(chosen)
    kept = np.unique(faces)
    return kept, np.searchsorted(kept, faces)


def _cheapest(vertices, faces, quadric, importance, rim) -> tuple[np.ndarray, np.ndarray]:
    """The cheapest neighbour that each vertex may collapse onto, and the cost (infinite if there is none)."""
    count = len(vertices)
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    keys = np.unique(np.concatenate([start * count + end, end * count + start]))
    edges = np.stack([keys // count, keys % count], -1)
    adjacent = sparse.csr_array((np.ones(len(edges), dtype=np.int32), edges.T), shape=(count, count))
    common = sparse.coo_array(adjacent @ adjacent * adjacent)  # neighbours shared by an edge's two ends
    fit = (common.data == 2) & ~rim[common.row]
    edges = np.stack([common.row[fit], common.col[fit]], -1).astype(np.int64)
    points = np.concatenate([vertices[edges[:, 1]], np.ones((len(edges), 1))], 1)
    error = np.einsum("ni,nij,nj->n", points, quadric[edges[:, 0]] + quadric[edges[:, 1]], points)
    length = ((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1)
    error = (np.maximum(error, 0) + 1e-7 * length) * importance[edges[:, 0]]
    order = np.lexsort((error, edges[:, 0]))
    vertex, first = np.unique(edges[order, 0], return_index=True)
    target, cost = np.arange(count), np.full(count, np.inf)
    target[vertex], cost[vertex] = edges[order[first], 1], error[order[first]]
    # Not those whose fall would turn one of their faces over, or nearly so.
    before = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    for corner in range(3):
        vertex, left, right = (faces[:, (corner + k) % 3] for k in range(3))
        onto = target[vertex]
        after = np.cross(vertices[left] - vertices[onto], vertices[right] - vertices[onto])
        size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        gone = (onto == left) | (onto == right)
        cost[vertex[~gone & ((before * after).sum(1) <= 0.3 * size)]] = np.inf
    return target, cost
