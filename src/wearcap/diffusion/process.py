"""The forward process and one exact step back (thesis eq. 6.1–6.3; α_t there is the cumulative product ᾱ)."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.diffusion.schedule import Schedule

Level = Float[Tensor, "batch #time"] | Float[Tensor, "batch #time #feature"]
"""A noise level for every window or frame, or for every frame and feature (ECHO §3.2: per modality)."""


def add_noise(
    x0: Float[Tensor, "batch time feature"],
    noise: Float[Tensor, "batch time feature"],
    level: Level,
    schedule: Schedule,
) -> Float[Tensor, "batch time feature"]:
    """x_t = √ᾱ x0 + √(1 - ᾱ) ε (thesis eq. 6.1); level 0 is x0 itself, whatever rounding makes of ᾱ."""
    level = _wide(level)
    alpha_bar = schedule(level)
    noised = alpha_bar.sqrt() * x0 + (1 - alpha_bar).clamp_min(0).sqrt() * noise
    return torch.where(level == 0, x0, noised)


def posterior_step(
    x_t: Float[Tensor, "batch time feature"],
    x0_hat: Float[Tensor, "batch time feature"],
    level: Level,
    level_next: Level,
    noise: Float[Tensor, "batch time feature"],
    schedule: Schedule,
    eta: float = 1.0,
) -> Float[Tensor, "batch time feature"]:
    """Sample x at `level_next` ≤ `level` from q(x_next | x_t, x̂0) (thesis eq. 6.2, 6.3).

    `eta` 1 is the thesis's stochastic posterior, 0 the deterministic step (DDIM); both preserve the marginals for a
    perfect x̂0. Where the level does not change, x_t stays; where it reaches 0, the result is x̂0.
    """
    level, level_next = _wide(level), _wide(level_next)
    now, after = schedule(level), schedule(level_next)
    noise_left, noise_now = 1 - after, (1 - now).clamp_min(1e-12)
    variance = noise_left / noise_now * (1 - now / after)
    spread = eta * variance.clamp_min(0).sqrt()
    # Weights of x̂0, x_t and the noise, which one level for all frames makes three numbers.
    kept = ((noise_left - spread**2).clamp_min(0) / noise_now).sqrt()
    clean = after.sqrt() - kept * now.sqrt()
    stays, ends = level == level_next, level_next == 0
    clean = torch.where(stays, 0.0, torch.where(ends, 1.0, clean))
    kept = torch.where(stays, 1.0, torch.where(ends, 0.0, kept))
    spread = torch.where(stays | ends, 0.0, spread)
    return clean * x0_hat + kept * x_t + spread * noise


def _wide(level: Level) -> Float[Tensor, "batch #time #feature"]:
    return level[..., None] if level.ndim == 2 else level


Denoise = Callable[[Float[Tensor, "batch time feature"], Float[Tensor, "batch 1"]], Float[Tensor, "batch time feature"]]
"""x̂0 from x_t and its noise level."""


def step_levels(steps: int, spacing: float = 1.0) -> Float[Tensor, "level"]:
    """The `steps` + 1 levels from 1 to 0 of a sampler: (1 - i / steps) to the power of `spacing`.

    1 spaces them evenly, as the thesis does; more takes smaller steps at low noise levels, less at high ones.
    """
    return torch.linspace(1, 0, steps + 1) ** spacing


def sample(
    denoise: Denoise,
    noise: Float[Tensor, "draw batch time feature"],
    schedule: Schedule,
    *,
    eta: float = 1.0,
    spacing: float = 1.0,
    observed: Float[Tensor, "batch time feature"] | None = None,
    is_observed: Bool[Tensor, "batch time"] | None = None,
) -> Float[Tensor, "batch time feature"]:
    """Draw x0 in `draw` steps between the levels of `step_levels`; noise[0] is the start, the rest the steps' noise.

    Where `is_observed`, every x̂0 is overwritten by `observed` (autoregressive inpainting, thesis eq. 6.5).
    The same noise gives the same sample, so windows of several wearers can share a batch.
    """
    steps = len(noise)
    levels = step_levels(steps, spacing).to(noise)
    x = noise[0]
    for step in range(steps):
        level, level_next = (levels[step + i].expand(x.shape[0], 1) for i in (0, 1))
        x0_hat = denoise(x, level)
        if observed is not None and is_observed is not None:
            x0_hat = torch.where(is_observed[..., None], observed, x0_hat)
        fresh = noise[step + 1] if step + 1 < steps else torch.zeros_like(x)
        x = posterior_step(x, x0_hat, level, level_next, fresh, schedule, eta)
    return x
