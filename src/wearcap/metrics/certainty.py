"""Whether a motion is as sure of its joints as it says: shares of errors within its deviations, and their likelihood; and
how deviations are fitted to errors."""

import torch
from jaxtyping import Float
from scipy.optimize import root_scalar
from scipy.special import ndtr, stdtrit
from torch import Tensor
from torch.distributions import Normal, StudentT

from wearcap.recording.motion import Motion, reach

SHARES = {"within_68": 0.6827, "within_95": 0.95}
"""Scores, and the share of errors that should be within the reach of which they say how many are."""
KNOWN_M = 0.001
"""Joints that are surer than this (m), as the measured head, say nothing."""
DOF = (1.0, 100.0)
"""Degrees of freedom from the heaviest tails that are fitted to those that count as normal."""


def deviations(prediction: Motion, truth: Motion) -> Float[Tensor, "time joint 3"] | None:
    """Errors along each axis of every joint in the motion's own deviations, NaN of joints that are measured; None of a
    motion that does not say how sure it is."""
    if prediction.joint_std is None:
        return None
    away = (prediction.T_world_joint.t - truth.T_world_joint.t).abs() / prediction.joint_std[..., None]
    return torch.where(prediction.joint_std[..., None] > KNOWN_M, away, torch.nan)


def certainty_scores(prediction: Motion, truth: Motion) -> dict[str, float]:
    """`within_68` and `within_95` (%), and `surprise`, the mean negative log likelihood of an error (m) along an axis under
    the motion's own distribution; none of a motion that does not say how sure it is."""
    away = deviations(prediction, truth)
    if away is None or prediction.joint_std is None:
        return {}
    away, dof = away[~away.isnan()], prediction.joint_dof
    std = prediction.joint_std[prediction.joint_std > KNOWN_M]
    shares = {name: 100 * (away <= reach(share, dof)).float().mean().item() for name, share in SHARES.items()}
    errors = Normal(0.0, 1.0) if dof is None else StudentT(dof, 0.0, 1 / stdtrit(dof, ndtr(1.0)))
    surprise = std.log().mean() - errors.log_prob(away).mean()
    return shares | {"surprise": surprise.item()}


def tails(away: Float[Tensor, "*error"]) -> tuple[float, float | None]:
    """(factor, degrees of freedom) by which 68.3 % and 95 % of errors `away`, in deviations, are within the reach of these
    shares, once the deviations are multiplied by the factor; None: they are normal, or have lighter tails."""
    within = away.flatten().double().sort().values
    near, far = (within[round(share * (len(within) - 1))].item() for share in SHARES.values())
    heaviest, normal = (reach(SHARES["within_95"], dof) for dof in DOF)
    if far <= normal * near:
        return near, None
    ratio = min(far / near, heaviest)
    return near, root_scalar(lambda dof: reach(SHARES["within_95"], dof) - ratio, bracket=DOF).root
