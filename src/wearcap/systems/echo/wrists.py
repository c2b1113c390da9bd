"""Bodies that reach for the tracked wrists in every step, so that trunk, head and shoulders follow the hands (ours)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import WRISTS, Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.features import POINTS, EchoFeatures
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.queue import Conditioning

EPSILON = 1e-6
"""Keeps a step finite where the wrists are met (m²)."""


@dataclass(frozen=True, eq=False)
class Reaching:
    """The bodies of one window, and the tracked points that they must reach."""

    net: EchoDenoiser
    features: EchoFeatures
    skeleton: Skeleton
    t_parent_joint: Float[Tensor, "batch 1 joint 3"]
    """Bones of each batch item (m)."""
    conditioning: Conditioning
    frame: Rigid

    def misses(self, human: Float[Tensor, "batch frame human"]) -> Float[Tensor, "batch frame"]:
        """Squared distances (m²) of both wrists to the tracked ones, relative to the head, from normalised features."""
        size, normalizer, joints = self.net.sizes[0], self.net.motion_normalizer, self.skeleton.indices(*POINTS)
        raw = human * normalizer.scale[:size].to(human) + normalizer.mean[:size].to(human)
        bones = self.t_parent_joint.to(human).expand(-1, human.shape[1], -1, -1)
        at = forward_kinematics(self.skeleton, *self.features.decode_body(raw, self.frame), bones).t[..., joints, :]
        away = at - self.conditioning.t_world_point
        miss = (away[:, :, 1:] - away[:, :, :1]).square().sum(-1)
        return (miss * self.conditioning.seen[:, :, 1:]).sum(-1)

    def corrected(
        self, x0_hat: Float[Tensor, "batch frame feature"], share: float
    ) -> Float[Tensor, "batch frame feature"]:
        """x̂0 after a gradient step of Polyak's length times `share`: as far as the misses would vanish, were they linear.

        All joints between head and wrists turn, each by as much as it varies in people; the root's position, which the
        measured head gives, is left as it is.
        """
        size = self.net.sizes[0]
        with torch.enable_grad():
            human = x0_hat[..., :size].detach().clone().requires_grad_(True)
            misses = self.misses(human)
            (gradient,) = torch.autograd.grad(misses.sum(), human)
        gradient[..., :3] = 0.0
        length = share * misses.detach() / (gradient.square().sum(-1) + EPSILON)
        step = length * self.conditioning.valid
        return torch.cat([x0_hat[..., :size] - step[..., None] * gradient, x0_hat[..., size:]], -1)


def reaches(features: EchoFeatures) -> bool:
    """Whether the wrists are among what a model is given."""
    return set(WRISTS) <= set(features.points)
