"""Strided sampling of whole windows, with inpainting of observed frames."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.diffusion.process import posterior_step
from wearcap.diffusion.schedule import Schedule

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
