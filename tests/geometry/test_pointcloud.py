"""Point-cloud queries against brute force."""

import math

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry.pointcloud import PointIndex, statistical_outliers, voxel_downsample

CLOUD = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
QUERIES = torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(1))


def test_nearest_agrees_with_brute_force():
    every = torch.cdist(QUERIES.reshape(-1, 3), CLOUD).reshape(5, 7, 400)
    distance, index = PointIndex(CLOUD).nearest(QUERIES)
    assert torch.equal(index, every.argmin(-1))
    assert torch.allclose(distance, every.amin(-1), atol=1e-5)
    distances, indices = PointIndex(CLOUD).neighbors(QUERIES, 4)
    assert torch.equal(indices, every.topk(4, largest=False).indices)
    assert torch.equal(distances[..., 0], distance)


def test_more_neighbors_than_points():
    distance, index = PointIndex(CLOUD[:3]).neighbors(QUERIES, 10)
    assert index.shape == (5, 7, 3)
    assert distance.isfinite().all()


def test_distance_pulls_queries_towards_the_cloud():
    query = torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    distance, _ = PointIndex(torch.zeros(1, 3, dtype=torch.float64)).nearest(query)
    (gradient,) = torch.autograd.grad(distance.sum(), query)
    assert gradient[0].tolist() == [1, 0, 0]
    assert gradient[1].isfinite().all()


def test_voxels():
    points = torch.tensor([[0.01, 0, 0], [0.03, 0, 0], [-0.01, 0, 0], [5, 5, 5]])
    centres, voxel = voxel_downsample(points, 0.05)
    assert len(centres) == 3
    assert voxel[0] == voxel[1]
    assert len({voxel[i].item() for i in (0, 2, 3)}) == 3
    assert torch.allclose(centres[voxel[0]], torch.tensor([0.02, 0, 0]))
    assert torch.allclose(centres[voxel[3]], points[3])


def test_statistical_outliers():
    cloud = torch.cat([CLOUD, torch.tensor([[4.0, 4, 4], [-3, 0, 0]])])
    valid = statistical_outliers(cloud, neighbor_count=8)
    assert not valid[-2:].any()
    assert valid[:-2].float().mean() > 0.95


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.tensor([[0.0, math.nan, 0.0]])])
def test_clouds_that_cannot_be_searched(points):
    with pytest.raises(WearcapError, match="finite"):
        PointIndex(points)
