"""What observed frames tell of those between them: the residual of x̂0 in observed frames is spread in time."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

NOISE = 1e-3
"""Variance of an observation beside the residual's own, which keeps neighbouring observations solvable."""


def residual_weights(
    is_observed: Bool[Tensor, "*batch frame"], alike: Bool[Tensor, "*#batch frame frame"], frames: float
) -> Float[Tensor, "*batch frame frame"]:
    """Weights by which each frame (row) takes over the residuals of the observed ones (column): the mean of a Gaussian process
    with a Matérn 5/2 kernel, which is smooth, interpolates between observations and decays over `frames`.

    Only frames that are `alike`, those of one object for instance, have anything to do with each other.
    """
    place = torch.arange(is_observed.shape[-1], dtype=torch.float64, device=is_observed.device)
    distance = math.sqrt(5) * (place[:, None] - place).abs() / frames
    kernel = (1 + distance + distance**2 / 3) * (-distance).exp() * alike
    kernel = kernel * is_observed[..., None, :]
    among = kernel * is_observed[..., None]
    # Frames that nobody observed have the identity's rows: nothing is taken from them.
    solvable = among + torch.diag_embed(torch.where(is_observed, NOISE, 1.0).to(among))
    return torch.linalg.solve(solvable, kernel.mT).mT.float()


def with_residuals(
    x0_hat: Float[Tensor, "batch frame feature"],
    observed: Float[Tensor, "batch frame feature"],
    weights: Float[Tensor, "batch modality frame frame"],
    sizes: tuple[int, ...],
) -> Float[Tensor, "batch frame feature"]:
    """x̂0 corrected by the residuals of the observed frames, spread by the `weights` of each modality (`residual_weights`)."""
    parts = zip(x0_hat.split(sizes, -1), observed.split(sizes, -1), weights.unbind(1))
    return torch.cat([part + weight @ (true - part) for part, true, weight in parts], -1)
