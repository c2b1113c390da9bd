"""Residuals of observed frames are taken over by their neighbours: met, smooth between them, gone far away."""

import torch

from wearcap.diffusion.observed import residual_weights, with_residuals

EVERYONE = torch.ones(1, 1, 1, dtype=torch.bool)


def seen_at(*frames: int, count: int = 60) -> torch.Tensor:
    observed = torch.zeros(1, count, dtype=torch.bool)
    observed[0, list(frames)] = True
    return observed


def test_observed_frames_are_met_and_far_ones_left_alone():
    weights = residual_weights(seen_at(10, 14), EVERYONE.expand(1, 60, 60), 4.0)[0]
    assert torch.count_nonzero(weights.abs().sum(0)) == 2, "only the observed frames give"
    residual = torch.zeros(60)
    residual[10], residual[14] = 1.0, 3.0
    spread = weights @ residual
    torch.testing.assert_close(spread[[10, 14]], residual[[10, 14]], atol=0.01, rtol=0)
    assert (spread[10:15].diff() > 0).all(), "between the two"
    assert (spread[15:].diff() < 1e-6).all(), "less and less"
    assert spread[50:].abs().max() < 1e-3


def test_a_slow_residual_is_found_between_its_observations():
    time = torch.arange(60) / 60
    residual = torch.sin(2 * torch.pi * 2 * time) + 0.5
    weights = residual_weights(seen_at(*range(2, 60, 6)), EVERYONE.expand(1, 60, 60), 8.0)[0]
    inside = slice(4, 56)
    found = weights @ residual
    assert (found - residual)[inside].abs().max() < 0.1
    assert found.diff(n=3)[inside].abs().max() < 4 * residual.diff(n=3).abs().max() + 0.02, "smooth"


def test_neighbouring_observations_do_not_blow_up():
    weights = residual_weights(torch.ones(2, 60, dtype=torch.bool), EVERYONE.expand(2, 60, 60), 30.0)
    assert weights.isfinite().all()
    noise = torch.randn(60, generator=torch.Generator().manual_seed(0))
    assert (weights[0] @ noise).abs().max() < 4


def test_frames_of_another_object_hear_nothing():
    number = torch.arange(60)[None] // 30
    weights = residual_weights(seen_at(28), number[:, :, None] == number[:, None], 8.0)[0]
    assert weights[25:30, 28].min() > 0.5
    assert (weights[30:] == 0).all()


def test_every_modality_has_its_own_observations():
    random = torch.Generator().manual_seed(0)
    x0_hat, observed = torch.randn(2, 60, 5, generator=random), torch.randn(2, 60, 5, generator=random)
    is_observed = torch.zeros(2, 2, 60, dtype=torch.bool)
    is_observed[0, 1, 7] = True
    weights = residual_weights(is_observed, torch.ones(1, 1, 60, 60, dtype=torch.bool), 8.0)
    corrected = with_residuals(x0_hat, observed, weights, (2, 3))
    assert torch.equal(corrected[..., :2], x0_hat[..., :2])
    assert torch.equal(corrected[1], x0_hat[1])
    torch.testing.assert_close(corrected[0, 7, 2:], observed[0, 7, 2:], atol=0.01, rtol=0)
    assert not torch.allclose(corrected[0, 9, 2:], x0_hat[0, 9, 2:], atol=0.01)
