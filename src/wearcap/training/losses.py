"""Loss terms: pure functions of predictions and ground truth, averaged over weighted frames (0 on padding)."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def exact(tensor: Tensor) -> torch.autocast:
    """A context for geometry, inputs and losses under a training's autocast, which rounds 10 m to 3 cm in matrix products."""
    return torch.autocast(tensor.device.type, enabled=False)


EPSILON_M2 = 1e-6
"""Keeps the gradient of a distance finite where prediction and target meet."""


def masked_mean(value: Float[Tensor, "batch time"], weight: Float[Tensor, "batch time"]) -> Float[Tensor, ""]:
    """Mean over all frames, in which padding (weight 0) counts as zero.

    With a division by the number of valid frames the gradient would depend on how a batch is split among processes.
    """
    return (value * weight).mean()


def joint_position(
    prediction: Float[Tensor, "batch time joint 3"],
    target: Float[Tensor, "batch time joint 3"],
    weight: Float[Tensor, "batch time"],
) -> Float[Tensor, ""]:
    """Distance of joints with both bodies anchored to the same head (m; ours)."""
    distance = ((prediction - target).square().sum(-1) + EPSILON_M2).sqrt()
    return masked_mean(distance.mean(-1), weight)


def joint_velocity(
    prediction: Float[Tensor, "batch time joint 3"],
    target: Float[Tensor, "batch time joint 3"],
    weight: Float[Tensor, "batch time"],
    fps: float,
) -> Float[Tensor, ""]:
    """Squared difference of joint velocities (m²/s²; ours)."""
    error = (prediction - target).diff(dim=1) * fps
    return masked_mean(error.square().sum(-1).mean(-1), weight[:, 1:])


def balanced_cross_entropy(
    logit: Float[Tensor, "batch time foot"],
    contact: Float[Tensor, "batch time foot"],
    share: float | None,
    weight: Float[Tensor, "batch time"],
) -> Float[Tensor, ""]:
    """Cross entropy in which contact, a `share` of the training's labels, and its absence weigh alike (ours); without a
    share plain cross entropy."""
    share = 0.5 if share is None else share
    balance = torch.where(contact > 0.5, 0.5 / share, 0.5 / (1 - share))
    error = F.binary_cross_entropy_with_logits(logit, contact, balance, reduction="none")
    return masked_mean(error.mean(-1), weight)


def surprise(
    error: Float[Tensor, "batch time joint 3"],
    std: Float[Tensor, "batch time joint"],
    weight: Float[Tensor, "batch time"],
) -> Float[Tensor, ""]:
    """Mean negative log likelihood of errors (m) of joints under normal distributions alike along all axes, without its
    constant; errors below a millimetre count as one."""
    square = error.square().mean(-1) + EPSILON_M2
    return masked_mean((std.log() + square / (2 * std.square())).mean(-1), weight)


def foot_skate(
    feet: Float[Tensor, "batch time foot point 3"],
    contact: Float[Tensor, "batch time foot"],
    weight: Float[Tensor, "batch time"],
    fps: float,
) -> Float[Tensor, ""]:
    """Squared speed (m²/s²) of the slowest point of a foot during its ground-truth contacts (ours)."""
    speed = (feet.diff(dim=1) * fps).square().sum(-1).amin(-1)
    stands = contact[:, 1:] * contact[:, :-1]
    return masked_mean((speed * stands).mean(-1), weight[:, 1:])
