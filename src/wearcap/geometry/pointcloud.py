"""Point clouds: nearest neighbours, downsampling, outliers."""

import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.errors import WearcapError


class PointIndex:
    """A KD-tree over points (m) for nearest-neighbour queries."""

    def __init__(self, points: Float[Tensor, "point 3"]):
        if not len(points) or not points.isfinite().all():
            raise WearcapError(
                f"cannot search {len(points)} points" + (" with NaN or infinity among them" if len(points) else ""),
                expected="at least one point, all finite",
            )
        self.points = points
        self._tree = KDTree(points.detach().cpu().double().numpy())

    def nearest(
        self, queries: Float[Tensor, "*batch 3"], workers: int = 1
    ) -> tuple[Float[Tensor, "*batch"], Int64[Tensor, "*batch"]]:
        """Distance (m) to the nearest point and its index; the distance is differentiable in the queries."""
        _, index = self._tree.query(queries.detach().cpu().double().numpy(), workers=workers)
        index = torch.as_tensor(index, device=queries.device)
        return (queries - self.points.to(queries)[index]).norm(dim=-1), index

    def neighbors(
        self, queries: Float[Tensor, "*batch 3"], count: int, workers: int = 1
    ) -> tuple[Float[Tensor, "*batch neighbor"], Int64[Tensor, "*batch neighbor"]]:
        """Distances (m) and indices of the `count` nearest points (fewer if the cloud is smaller)."""
        count = min(count, len(self.points))
        _, index = self._tree.query(
            queries.detach().cpu().double().numpy(), k=list(range(1, count + 1)), workers=workers
        )
        index = torch.as_tensor(index, device=queries.device)
        return (queries[..., None, :] - self.points.to(queries)[index]).norm(dim=-1), index


def voxel_downsample(
    points: Float[Tensor, "point 3"], voxel_size: float
) -> tuple[Float[Tensor, "voxel 3"], Int64[Tensor, "point"]]:
    """Mean of the points in each occupied voxel (edge length in m), and the voxel index of every point."""
    cell = torch.floor(points.double() / voxel_size).long()
    _, voxel, count = torch.unique(cell, dim=0, return_inverse=True, return_counts=True)
    total = torch.zeros(len(count), 3, dtype=torch.float64, device=points.device)
    total.index_add_(0, voxel, points.double())
    return (total / count[:, None]).to(points.dtype), voxel


def statistical_outliers(
    points: Float[Tensor, "point 3"], neighbor_count: int = 16, max_deviation: float = 2.0
) -> Bool[Tensor, "point"]:
    """Mask of valid points, whose mean distance to their neighbours is at most `max_deviation` σ above the cloud's
    mean."""
    if len(points) < 3:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    distance, _ = PointIndex(points).neighbors(points, neighbor_count + 1)
    mean = distance[:, 1:].mean(1)
    return mean <= mean.mean() + max_deviation * mean.std()
