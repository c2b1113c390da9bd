"""Whether a motion is as sure of its joints as it says: shares of errors within its deviations, and their likelihood."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.recording.motion import Motion

QUANTILES = {"within_68": 1.0, "within_95": 1.96}
"""Scores, and how many deviations they reach: 68.3 % and 95.0 % of a normal distribution's errors are within them."""
KNOWN_M = 0.001
"""Joints that are surer than this (m), as the measured head, say nothing."""


def deviations(prediction: Motion, truth: Motion) -> Float[Tensor, "time joint 3"] | None:
    """Errors along each axis of every joint in the motion's own deviations, NaN of joints that are measured; None of a
    motion that does not say how sure it is."""
    if prediction.joint_std is None:
        return None
    away = (prediction.T_world_joint.t - truth.T_world_joint.t).abs() / prediction.joint_std[..., None]
    return torch.where(prediction.joint_std[..., None] > KNOWN_M, away, torch.nan)


def certainty_scores(prediction: Motion, truth: Motion) -> dict[str, float]:
    """`within_68` and `within_95` (%), and `surprise`, the mean negative log likelihood of an error (m) along an axis under
    a normal distribution; none of a motion that does not say how sure it is."""
    away = deviations(prediction, truth)
    if away is None or prediction.joint_std is None:
        return {}
    away = away[~away.isnan()]
    std = prediction.joint_std[prediction.joint_std > KNOWN_M]
    shares = {name: 100 * (away <= reach).float().mean().item() for name, reach in QUANTILES.items()}
    surprise = away.square().mean() / 2 + std.log().mean() + math.log(2 * math.pi) / 2
    return shares | {"surprise": surprise.item()}
