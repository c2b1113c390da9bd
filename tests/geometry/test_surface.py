"""The grid answers as a KD-tree does, and finds planted planes."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from wearcap.errors import WearcapError
from wearcap.geometry.surface import SurfaceIndex


@pytest.mark.parametrize("count", [1, 40, 20_000])
@pytest.mark.parametrize("cell_m", [None, 0.013, 0.4])
def test_nearest_agrees_with_a_tree(count, cell_m):
    rng = np.random.default_rng(count)
    points = rng.uniform(-2, 2, (count, 3)).astype(np.float32)
    queries = rng.uniform(-2.5, 2.5, (300, 3))
    distance, point = SurfaceIndex.build(points, cell_m).nearest(queries, reach_m=0.3)
    true, _ = KDTree(points.astype(np.float64)).query(queries)
    near = true < 0.3
    assert np.allclose(distance[near], true[near], atol=1e-6)
    assert np.allclose(np.linalg.norm(point[near] - queries[near], axis=1), true[near], atol=1e-6)
    assert np.isinf(distance[~near]).all()
    assert np.isnan(point[~near]).all()


def test_planes_of_a_tilted_noisy_floor_look_up():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (40_000, 2))
    z = 0.2 * xy[:, 0] - 0.1 * xy[:, 1] + rng.normal(0, 0.002, len(xy))
    index = SurfaceIndex.build(np.column_stack([xy, z]).astype(np.float32))
    queries = np.column_stack([rng.uniform(-0.8, 0.8, (50, 2)), np.zeros(50)])
    queries[:, 2] = 0.2 * queries[:, 0] - 0.1 * queries[:, 1] + rng.uniform(-0.05, 0.05, 50)
    origin, normal = index.plane(queries)
    true = np.array([-0.2, 0.1, 1.0]) / np.linalg.norm([-0.2, 0.1, 1.0])
    assert np.degrees(np.arccos(normal @ true)).max() < 2.5
    height = queries @ true
    assert np.abs(((queries - origin) * normal).sum(1) - height).max() < 0.002


def test_nothing_near_gives_no_plane():
    index = SurfaceIndex.build(np.zeros((3, 3), np.float32))
    origin, normal = index.plane(np.array([[0.0, 0.0, 0.1], [5.0, 5.0, 5.0]]))
    assert np.isnan(origin).all()
    assert np.isnan(normal).all()


def test_an_empty_cloud_and_a_kilometre_are_refused():
    with pytest.raises(WearcapError, match="at least one point"):
        SurfaceIndex.build(np.zeros((0, 3), np.float32))
    with pytest.raises(WearcapError, match="millimetres"):
        SurfaceIndex.build(np.array([[0, 0, 0], [2e5, 0, 0]], np.float32))
