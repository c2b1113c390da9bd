"""The motion autoencoder: its size, its latent vectors, what it can learn."""

import pytest
import torch
from torch.nn import functional as F

from wearcap.models.motion_autoencoder import MotionAutoencoder


def small(**settings) -> MotionAutoencoder:
    torch.manual_seed(0)
    return MotionAutoencoder(12, 16, (24, 24), **({"latent": 8} | settings))


def test_it_is_as_small_as_documented():
    net = MotionAutoencoder(143)
    assert sum(weight.numel() for weight in net.parameters()) < 1e6
    features = torch.randn(3, 80, 143)
    assert net.encode(features).shape == (3, 64)
    assert net(features).shape == features.shape


def test_windows_do_not_see_each_other_when_compared():
    net, features = small(), torch.randn(5, 16, 12)
    net(features)
    net.eval()
    torch.testing.assert_close(net.encode(features)[2:3], net.encode(features[2:3]))


def test_it_learns_to_rebuild_and_its_latent_is_standardised():
    net = small()
    random = torch.Generator().manual_seed(0)
    phase = 6.28 * torch.rand(256, 1, 12, generator=random)[..., :3].repeat(1, 1, 4)
    features = 5 + 2 * torch.sin(torch.arange(16)[:, None] * 0.4 + phase)
    net.normalizer.set(features.mean((0, 1)), features.std((0, 1)))
    optimizer = torch.optim.Adam(net.parameters(), 1e-2)
    for _ in range(150):
        loss = F.mse_loss(net(features), net.normalizer(features))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    net.eval()
    assert F.mse_loss(net(features), net.normalizer(features)) < 0.1
    latent = net.encode(features)
    assert latent.mean(0).abs().max() < 0.5
    assert (latent.std(0) - 1).abs().max() < 0.4


def test_its_latent_keeps_the_order_of_what_happened():
    net = small().eval()
    features = torch.randn(4, 16, 12)
    assert (net.encode(features) - net.encode(features.flip(1))).norm(dim=-1).min() > 1e-2


def test_frames_must_halve():
    with pytest.raises(ValueError, match="18 frames cannot be halved 2 times"):
        MotionAutoencoder(12, 18, (24, 24))
