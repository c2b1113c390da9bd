"""Farthest-point sampling and neighbourhoods of point clouds: batched, exact, and independent of the points' order."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor


@torch.no_grad()
def farthest_points(points: Float[Tensor, "batch point 3"], count: int) -> Int64[Tensor, "batch chosen"]:
    """Indices of `count` points, each the farthest from all before it; the first is the farthest from the origin.

    Its first n indices are the farthest-point sample of n. Points at equal positions are used once before any repeats.
    """
    x, y, z = (axis.contiguous() for axis in points.unbind(-1))
    chosen = torch.empty(len(points), count, dtype=torch.int64, device=points.device)
    apart = torch.full_like(x, torch.inf)
    latest = points.square().sum(-1).argmax(-1, keepdim=True)
    for number in range(count):
        chosen[:, number] = latest[:, 0]
        square = (x - x.gather(1, latest)).square_()
        square += (y - y.gather(1, latest)).square_()
        square += (z - z.gather(1, latest)).square_()
        apart = torch.minimum(apart, square)
        latest = apart.argmax(-1, keepdim=True)
    return chosen


@torch.no_grad()
def spread_first(points: Float[Tensor, "batch point 3"], count: int) -> Int64[Tensor, "batch point"]:
    """A permutation of all points that starts with the farthest-point sample of `count`."""
    chosen = farthest_points(points, count)
    rank = torch.full(points.shape[:2], count, dtype=torch.int64, device=points.device)
    rank.scatter_(1, chosen, torch.arange(count, device=points.device).expand_as(chosen))
    return rank.argsort(dim=1, stable=True)


@torch.no_grad()
def ball_query(
    centers: Float[Tensor, "batch center 3"], points: Float[Tensor, "batch point 3"], radius: float, neighbours: int
) -> Int64[Tensor, "batch center neighbour"]:
    """Indices of the `neighbours` points nearest to each centre within a radius, filled up by the nearest one.

    The nearest point is included at any distance.
    """
    apart = torch.cdist(centers, points, compute_mode="donot_use_mm_for_euclid_dist")
    near, index = apart.topk(min(neighbours, points.shape[1]), largest=False)
    return torch.where(near <= radius, index, index[..., :1])


def rows_at(
    values: Float[Tensor, "batch point feature"], index: Int64[Tensor, "batch *at"]
) -> Float[Tensor, "batch *at feature"]:
    """Gathers rows of a batch of tables by index."""
    batch, count, width = values.shape
    first = torch.arange(batch, device=index.device) * count
    flat = (index.flatten(1) + first[:, None]).flatten()
    return values.reshape(-1, width).index_select(0, flat).reshape(*index.shape, width)
