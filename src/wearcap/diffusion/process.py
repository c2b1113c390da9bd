"""The forward process and one exact step back (thesis eq. 6.1–6.3; α_t there is the cumulative product ᾱ)."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.diffusion.schedule import Schedule


def add_noise(
    x0: Float[Tensor, "batch time feature"],
    noise: Float[Tensor, "batch time feature"],
    level: Float[Tensor, "batch #time"],
    schedule: Schedule,
) -> Float[Tensor, "batch time feature"]:
    """x_t = √ᾱ x0 + √(1 - ᾱ) ε, with a noise level for every frame (thesis eq. 6.1)."""
    alpha_bar = schedule(level)[..., None]
    return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * noise


def posterior_step(
    x_t: Float[Tensor, "batch time feature"],
    x0_hat: Float[Tensor, "batch time feature"],
    level: Float[Tensor, "batch #time"],
    level_next: Float[Tensor, "batch #time"],
    noise: Float[Tensor, "batch time feature"],
    schedule: Schedule,
    eta: float = 1.0,
) -> Float[Tensor, "batch time feature"]:
    """Sample x at `level_next` ≤ `level` from q(x_next | x_t, x̂0) (thesis eq. 6.2, 6.3).

    `eta` 1 is the stochastic posterior of the document, 0 the deterministic step (DDIM); both leave the marginals of
    a perfect x̂0 as they are. Frames whose level does not change keep x_t; frames that reach level 0 become x̂0.
    """
    now, after = schedule(level)[..., None], schedule(level_next)[..., None]
    noise_left, noise_now = 1 - after, (1 - now).clamp_min(1e-12)
    variance = noise_left / noise_now * (1 - now / after)
    spread = eta * variance.clamp_min(0).sqrt()
    epsilon_hat = (x_t - now.sqrt() * x0_hat) / noise_now.sqrt()
    x_next = (
        after.sqrt() * x0_hat + (noise_left - spread**2).clamp_min(0).sqrt() * epsilon_hat + spread * noise
    )
    x_next = torch.where((level_next == 0)[..., None], x0_hat, x_next)
    return torch.where((level == level_next)[..., None], x_t, x_next)
