"""Fréchet distance against the closed form and SciPy's matrix root, diversity against plain loops."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm

from wearcap.errors import WearcapError
from wearcap.metrics.distribution import DIVERSITY_SAMPLES, diversity, frechet_distance


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def gaussian(mean: list[float], variance: list[float], samples: int = 400) -> torch.Tensor:
    """Samples whose own mean and covariance are exactly these (independent axes)."""
    raw = randn(samples, len(mean))
    raw = raw - raw.mean(0)
    white = raw @ torch.linalg.inv(torch.linalg.cholesky(torch.cov(raw.T))).T
    return white * torch.tensor(variance, dtype=torch.float64).sqrt() + torch.tensor(mean)


def test_two_gaussians_have_their_closed_form():
    mean, mean_true = [0.0, 1.0, -2.0], [3.0, 1.0, 2.0]
    variance, variance_true = [4.0, 1.0, 0.25], [1.0, 9.0, 0.25]
    expected = 25.0 + sum((math.sqrt(a) - math.sqrt(b)) ** 2 for a, b in zip(variance, variance_true))
    found = frechet_distance(gaussian(mean, variance), gaussian(mean_true, variance_true))
    assert found.item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("features", [1, 5, 40])
def test_it_is_what_scipys_matrix_root_gives(features):
    a = (randn(300, features) @ randn(features, features, seed=1) + 1).float()
    b = randn(500, features, seed=2) @ randn(features, features, seed=3)
    mean_a, mean_b = (x.double().numpy().mean(0) for x in (a, b))
    cov_a, cov_b = (np.atleast_2d(np.cov(x.double().numpy(), rowvar=False)) for x in (a, b))
    root = np.asarray(sqrtm(cov_a @ cov_b)).real
    expected = ((mean_a - mean_b) ** 2).sum() + np.trace(cov_a + cov_b - 2 * root)
    assert frechet_distance(a, b.float()).item() == pytest.approx(expected, rel=1e-4)
    assert frechet_distance(a, b).item() == pytest.approx(frechet_distance(b, a).item(), rel=1e-9)


def test_a_set_is_at_no_distance_from_itself_however_flat():
    flat = randn(200, 3) @ randn(3, 64, seed=1)  # three of 64 dimensions, where matrix roots break down
    assert frechet_distance(flat, flat).item() == pytest.approx(0, abs=1e-9)
    assert frechet_distance(flat, flat[torch.randperm(200)]).item() == pytest.approx(0, abs=1e-9)
    moved = frechet_distance(flat, flat + 0.5)
    assert moved.item() == pytest.approx(64 * 0.25, rel=1e-9)


def test_it_grows_with_noise_and_with_lost_variety():
    true = randn(3000, 16)
    noisy = [frechet_distance(true + s * randn(3000, 16, seed=1), true).item() for s in (0.1, 0.3, 1.0)]
    assert 0 < noisy[0] < noisy[1] < noisy[2]
    poorer = [frechet_distance(true * s, true).item() for s in (0.9, 0.5, 0.0)]
    assert 0 < poorer[0] < poorer[1] < poorer[2]
    assert poorer[2] == pytest.approx(torch.cov(true.T).trace().item() + true.mean(0).square().sum().item())


def test_diversity_is_the_mean_distance_of_pairs_drawn_without_repeat():
    latent = randn(700, 8)
    order = torch.randperm(700, generator=torch.Generator().manual_seed(5)).tolist()
    total = 0.0
    for first, second in zip(order[:200], order[200:400]):
        total += math.sqrt(sum((latent[first, k] - latent[second, k]).item() ** 2 for k in range(8)))
    assert diversity(latent, 200, seed=5).item() == pytest.approx(total / 200)
    every = torch.pdist(latent).mean()
    assert diversity(latent).item() == pytest.approx(every.item(), rel=0.05)
    assert diversity(3 * latent + 1).item() == pytest.approx(3 * diversity(latent).item())
    assert diversity(torch.ones(600, 2)).item() == 0


@pytest.mark.parametrize(
    "call",
    [
        lambda: frechet_distance(randn(1, 4), randn(9, 4)),
        lambda: frechet_distance(randn(9, 4), torch.full((9, 4), torch.nan)),
        lambda: diversity(randn(2 * DIVERSITY_SAMPLES - 1, 4)),
    ],
    ids=["one sample", "NaN", "too few for two subsets"],
)
def test_what_has_no_distribution_is_refused(call):
    with pytest.raises(WearcapError):
        call()
