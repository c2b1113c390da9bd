"""Noise shared by the simulated sensors."""

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Float
from torch import Tensor


def smooth_noise(
    rng: np.random.Generator, length: int, features: int, period_s: float, fps: float
) -> Float[Tensor, "time feature"]:
    """Gaussian noise of unit deviation that changes over about `period_s` (0: white)."""
    sigma = period_s * fps / 4
    if sigma < 0.3:
        return torch.from_numpy(rng.standard_normal((length, features))).float()
    pad = int(4 * sigma) + 1
    white = rng.standard_normal((length + 2 * pad, features))
    smooth = scipy.ndimage.gaussian_filter1d(white, sigma, axis=0)[pad : pad + length]
    # A Gaussian kernel of width σ leaves white noise the variance 1 / (2 √π σ).
    return torch.from_numpy(smooth * np.sqrt(2 * np.sqrt(np.pi) * sigma)).float()


def random_walk(
    rng: np.random.Generator, length: int, features: int, per_sqrt_s: float, fps: float
) -> Float[Tensor, "time feature"]:
    """A walk from zero whose deviation after t seconds is per_sqrt_s · √t."""
    steps = rng.standard_normal((length, features)) * per_sqrt_s / np.sqrt(fps)
    steps[:1] = 0.0
    return torch.from_numpy(np.cumsum(steps, 0)).float()
