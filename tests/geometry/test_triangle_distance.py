"""Distances to triangles: against a dense sampling and against every triangle in turn."""

import numpy as np
import pytest

from wearcap.errors import WearcapError
from wearcap.geometry.triangle_distance import TriangleIndex


def soup(seed: int, faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles, some of them slivers and points."""
    random = np.random.default_rng(seed)
    vertices = random.normal(size=(faces, 1, 3)) + random.normal(scale=0.2, size=(faces, 3, 3))
    vertices[::7, 2] = vertices[::7, 1]
    vertices[::11, 1:] = vertices[::11, :1]
    return vertices.reshape(-1, 3), np.arange(3 * faces).reshape(-1, 3)


def brute_force(queries: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """By quadratic programming's corner cases: plane where the foot lies inside, else the three clamped sides."""
    best = np.full(len(queries), np.inf)
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) > 1e-12:
            unit = normal / np.linalg.norm(normal)
            foot = queries - ((queries - a) @ unit)[:, None] * unit
            sides = [np.cross(v - u, foot - u) @ unit for u, v in ((a, b), (b, c), (c, a))]
            inside = np.min(sides, 0) >= 0
            best[inside] = np.minimum(best, np.abs((queries - a) @ unit))[inside]
        for u, v in ((a, b), (b, c), (c, a)):
            share = np.clip((queries - u) @ (v - u) / max((v - u) @ (v - u), 1e-30), 0, 1)
            best = np.minimum(best, np.linalg.norm(queries - u - share[:, None] * (v - u), axis=1))
    return best


@pytest.mark.parametrize("faces", [1, 3, 4, 5, 300])
def test_the_tree_agrees_with_every_triangle_in_turn(faces: int):
    vertices, triangles = soup(faces, faces)
    queries = np.random.default_rng(0).normal(scale=2.0, size=(400, 3))
    distance, point = TriangleIndex.build(vertices, triangles).nearest(queries)
    assert np.allclose(distance, brute_force(queries, vertices[triangles]), atol=1e-9)
    assert np.allclose(distance, np.linalg.norm(queries - point, axis=1), atol=1e-9)
    assert np.allclose(brute_force(point, vertices[triangles]), 0, atol=1e-9), "the point is not on the surface"


def test_many_equal_faces_do_not_deepen_the_tree_without_end():
    vertices, faces = np.eye(3), np.tile([0, 1, 2], (1000, 1))
    distance, _ = TriangleIndex.build(vertices, faces).nearest(np.zeros((1, 3)))
    assert distance[0] == pytest.approx(1 / np.sqrt(3))


def test_a_mesh_without_faces_or_with_nan_is_refused():
    with pytest.raises(WearcapError, match="without faces"):
        TriangleIndex.build(np.zeros((3, 3)), np.zeros((0, 3), np.int64))
    with pytest.raises(WearcapError, match="NaN"):
        TriangleIndex.build(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
