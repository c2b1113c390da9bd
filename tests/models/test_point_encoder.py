"""PointNeXt: what its feature does not change with, exact sampling, gradients, learning, and what is refused."""

import pytest
import torch
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.models.checkpoint import load_network
from wearcap.models.point_encoder import PointNeXt, _ball_query, _rows_at, bounds, farthest_points, spread_first

SMALL = {"width": 8, "strides": [4, 2], "blocks": [0, 1], "neighbours": [8, 8], "radius": 0.3}


def clouds(count: int = 3, points: int = 200, seed: int = 0) -> torch.Tensor:
    """Ellipsoids' surfaces (m), in float64: no distance is on the verge."""
    random = torch.Generator().manual_seed(seed)
    directions = F.normalize(torch.randn(count, points, 3, generator=random, dtype=torch.float64), dim=-1)
    return directions * torch.tensor([0.5, 0.3, 0.2]) + torch.tensor([1.0, -2.0, 0.4])


def network(**more) -> PointNeXt:
    torch.manual_seed(0)
    net = PointNeXt(**(SMALL | more)).double()
    net.train()(clouds(8))  # statistics of batch norm
    return net.eval()


def test_order_place_and_scale_do_not_change_the_feature_and_turning_does():
    net, points = network(), clouds()
    feature = net(points)
    assert feature.shape == (3, net.size) == (3, 32)
    assert feature.std(0).max() > 1e-3
    shuffled = points[:, torch.randperm(points.shape[1])]
    torch.testing.assert_close(net(shuffled), feature)
    torch.testing.assert_close(net(points + torch.tensor([3.0, -1.0, 7.0])), feature)
    torch.testing.assert_close(net(4.0 * points), feature)
    torch.testing.assert_close(net(points[1:2]), feature[1:2])
    assert not torch.allclose(net(points[..., [1, 0, 2]] * torch.tensor([1.0, -1.0, 1.0])), feature, atol=1e-3)


def test_extents_are_given_beside_it():
    points = torch.tensor([[[0.0, 0.0, 0.0], [2.0, 1.0, 3.0], [1.0, 0.5, -1.0]]])
    torch.testing.assert_close(torch.cat(bounds(points), -1), torch.tensor([[1.0, 0.5, 2.0, 1.0, 0.5, 1.0]]))


def plain_farthest(points: torch.Tensor, count: int) -> list[int]:
    chosen = [int(points.norm(dim=-1).argmax())]
    while len(chosen) < count:
        apart = [min(float((p - points[c]).norm()) for c in chosen) for p in points]
        chosen.append(max(range(len(points)), key=apart.__getitem__))
    return chosen


def test_farthest_points_are_those_of_a_plain_loop():
    points = torch.randn(3, 60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = farthest_points(points, 20)
    assert found.tolist() == [plain_farthest(cloud, 20) for cloud in points]
    order = spread_first(points, 20)
    assert torch.equal(order[:, :20], found)
    assert torch.equal(order.sort(1).values, torch.arange(60).expand(3, 60))
    kept = _rows_at(points, found)
    # the farthest of the farthest are the first of them: what later stages rely on
    assert torch.equal(farthest_points(kept, 10), torch.arange(10).expand(3, 10))


def test_repeated_points_are_taken_last():
    points = torch.randn(1, 10, 3).repeat(1, 3, 1)
    assert sorted((farthest_points(points, 10) % 10).flatten().tolist()) == list(range(10))


def test_a_ball_holds_the_nearest_within_its_radius():
    points = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = _ball_query(points[:, :7], points, 0.8, 6)
    for cloud, rows in zip(points, found):
        for center, row in zip(cloud[:7], rows.tolist()):
            apart = (cloud - center).norm(dim=-1)
            inside = [i for i in apart.argsort().tolist() if apart[i] <= 0.8][:6]
            assert row == inside + [inside[0]] * (6 - len(inside))


def test_gradients_reach_every_weight_and_the_points():
    net, points = network().train(), clouds().requires_grad_()
    net(points).square().sum().backward()
    assert points.grad is not None
    assert points.grad.abs().sum() > 0
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_it_learns():
    torch.manual_seed(0)
    points = torch.cat([clouds(12, 64, 3), clouds(12, 64, 4)[..., [2, 1, 0]]]).float()
    labels = torch.arange(2).repeat_interleave(12)
    net, head = PointNeXt(**SMALL), torch.nn.Linear(32, 2)
    optimizer = torch.optim.Adam([*net.parameters(), *head.parameters()], lr=3e-3)
    losses = []
    for _ in range(12):
        optimizer.zero_grad()
        loss = F.cross_entropy(head(net(points)), labels)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


def test_a_feature_of_one_point_repeated_is_finite():
    assert network()(torch.ones(1, 50, 3, dtype=torch.float64)).isfinite().all()


def test_the_papers_size():
    net = PointNeXt()
    assert net.size == 1024
    # 4.523 M of OpenPoints' config with C=64, without its head of 512 and 256
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(4.523e6 - 667e3, rel=1e-3)


def test_what_is_refused():
    with pytest.raises(WearcapError, match="2 strides, 1 numbers of blocks"):
        PointNeXt(strides=[2, 2], blocks=[0], neighbours=[8, 8])
    with pytest.raises(WearcapError, match="clouds of 4 points"):
        network()(torch.zeros(1, 4, 3, dtype=torch.float64))
    with pytest.raises(WearcapError, match="another model, not of PointNeXt"):
        load_network("voxel_autoencoder", PointNeXt, "object_encoder", part="net.encoder")
