"""Voxel autoencoders: shapes, ranges, what each kind is and learns, and what is refused."""

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.metrics.detection import distance_mae_cm, occupancy_iou, occupied_distance_mae_cm
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.scene.voxels import VoxelGrid

KINDS = ("sparse", "convolutions")


def slabs(count: int, seed: int = 0) -> torch.Tensor:
    """Grids with a floor at some height and a wall at some distance, half of whose cells were seen."""
    random = torch.Generator().manual_seed(seed)
    grids = torch.full((count, 10, 10, 10), 0.1)
    for grid, floor, wall in zip(grids, *torch.randint(10, (2, count), generator=random)):
        grid[:, :, floor] = 0.1 * torch.rand(10, 10, generator=random)
        grid[wall] = 0.1 * torch.rand(10, 10, generator=random)
        grid[torch.rand(10, 10, 10, generator=random) < 0.8] = 0.1
    return grids


@pytest.mark.parametrize("layers", KINDS)
def test_shapes_and_ranges(layers):
    net = VoxelAutoencoder(layers=layers)
    assert (net.size, net.grid) == (128, VoxelGrid())
    grids = slabs(6).reshape(2, 3, 10, 10, 10)
    code = net.encode(grids)
    assert code.shape == (2, 3, 128)
    rebuilt = net.decode(30 * code)
    assert rebuilt.shape == grids.shape
    assert 0 <= rebuilt.min() <= rebuilt.max() <= 0.1
    assert net.encode(grids[:0]).shape == (0, 3, 128)
    torch.testing.assert_close(net.encode(grids[1, 2]), code[1, 2])
    net.loss(grids[0]).backward()
    assert all(parameter.grad is not None for parameter in net.parameters())


def test_the_papers_layers():
    """Kernel 3, 16/32/64/128 channels there and back, ReLU between, averaged to one vector."""
    layers = VoxelAutoencoder(layers="convolutions").layers
    down = [m for m in layers.encoder if isinstance(m, torch.nn.Conv3d)]
    up = [m for m in layers.decoder if isinstance(m, torch.nn.ConvTranspose3d)]
    assert [(m.in_channels, m.out_channels) for m in down] == [(1, 16), (16, 32), (32, 64), (64, 128)]
    assert [(m.in_channels, m.out_channels) for m in up] == [(128, 64), (64, 32), (32, 16), (16, 1)]
    assert {m.kernel_size for m in [*down, *up]} == {(3, 3, 3)}
    assert sum(isinstance(m, torch.nn.ReLU) for m in [*layers.encoder, *layers.decoder]) == 6


def test_the_sparse_kind_begins_at_principal_components():
    net, grids = VoxelAutoencoder(), slabs(400)
    net.start_from(grids)
    nearness = (1 - grids / 0.1).flatten(1)
    centered = nearness - nearness.mean(0)
    sums = net.layers.sums.detach()
    torch.testing.assert_close(sums @ sums.T, torch.eye(128), atol=1e-4, rtol=0)
    left = (centered - centered @ sums.T @ sums).square().sum()
    best = torch.linalg.svdvals(centered)[128:].square().sum()
    torch.testing.assert_close(left, best, rtol=1e-3, atol=0)
    assert net.encode(grids).std(0).sub(1).abs().max() < 0.05


@pytest.mark.parametrize(("layers", "steps", "share"), [("sparse", 50, 0.5), ("convolutions", 12, 0.8)])
def test_it_learns(layers, steps, share):
    torch.manual_seed(0)
    net, grids = VoxelAutoencoder(layers=layers), slabs(128 if layers == "sparse" else 16)
    net.start_from(grids)
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    losses = []
    for _ in range(steps):
        optimizer.zero_grad()
        loss = net.loss(grids)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < share * losses[0]
    if layers == "sparse":
        rebuilt = net.decode(net.encode(grids)).detach()
        assert occupancy_iou(rebuilt, grids, 0.1) > 0.5
        assert occupied_distance_mae_cm(rebuilt, grids, 0.1) < 3


def test_other_grids():
    net = VoxelAutoencoder(cells=9, size_m=1.8, clip_m=0.05, size=32, layers="convolutions")
    assert net.decode(net.encode(torch.full((2, 9, 9, 9), 0.05))).shape == (2, 9, 9, 9)
    assert net.grid == VoxelGrid(9, 1.8, 1.0, 0.05)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"layers": "deep"}, "no layers 'deep'"),
        ({"cells": 8, "layers": "convolutions"}, "too few"),
        ({"cells": 4}, "128 numbers for 64 cells"),
        ({"clip_m": 0.2}, "half a cell"),
    ],
)
def test_what_is_refused(settings, message):
    with pytest.raises(WearcapError, match=message):
        VoxelAutoencoder(**settings)


def test_scores_of_grids():
    true, rebuilt = torch.full((2, 3, 3, 3), 0.1), torch.full((2, 3, 3, 3), 0.1)
    assert occupancy_iou(rebuilt, true, 0.1) == 1
    true[0, 0, 0, :2], rebuilt[0, 0, 0, 1:] = 0.02, 0.05
    assert occupancy_iou(rebuilt, true, 0.1) == pytest.approx(1 / 3)
    assert occupancy_iou(rebuilt, true, 0.1, border_m=0.04) == 0
    assert distance_mae_cm(rebuilt, true) == pytest.approx((8 + 3 + 5) / 54)
    assert occupied_distance_mae_cm(rebuilt, true, 0.1) == pytest.approx((8 + 3) / 2)
    assert occupancy_iou(rebuilt.half().float(), rebuilt, 0.1) == 1
