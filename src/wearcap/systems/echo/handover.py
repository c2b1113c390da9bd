"""Objects in the hand are where the tracked wrist says: the hand-over between an object's pose in the canonical frame and in
the wrists' axes (ours, `EchoFeatures.object_in_wrists`)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.features import HANDS, OBJECT_SIZE, EchoFeatures
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.queue import Conditioning

UNSURE = 0.25
"""Contact probability up to which a wrist does not count; from one minus this on it counts in full."""
FADE = 7
"""Frames (at 30 Hz, odd) over which a wrist's weight is averaged."""


def in_hand(
    contact_prob: Float[Tensor, "batch frame contact"],
    has_object: Bool[Tensor, "batch frame"],
    valid: Bool[Tensor, "batch frame"],
) -> Float[Tensor, "batch frame wrist"]:
    """Weight of each wrist's pose for the object: 0 where its hand does not touch the object, 1 within a contact.

    It grows and falls within the contact, so that an object that is released does not follow the hand. Frames beyond
    the window's ends, and padding, do not count.
    """
    prob = torch.stack([contact_prob[..., points].amax(-1) for points in HANDS.values()], 1)
    holds = ((prob - UNSURE) / (1 - 2 * UNSURE)).clamp(0, 1) * has_object[:, None]
    holds = torch.where(valid[:, None], holds, 1.0)
    least = -F.max_pool1d(-holds, FADE, 1, FADE // 2)
    return F.avg_pool1d(least, FADE, 1, FADE // 2, count_include_pad=False).mT


def handed_over(
    features: EchoFeatures,
    value: Float[Tensor, "batch frame object"],
    frames: Sequence[Rigid],
    weights: Float[Tensor, "batch frame wrist"],
) -> Float[Tensor, "batch frame 9"]:
    """The object in the first of `EchoFeatures.object_frames`: where it is there, blended with where each wrist has it."""
    own, *parts = value.split(OBJECT_SIZE, -1)
    rest = (1 - weights).prod(-1, keepdim=True)
    total = own * rest
    for part, wrist, weight in zip(parts, frames[1:], weights.split(1, -1)):
        total = total + weight * features.encode_object(features.decode_object(part, wrist), frames[0])
    return total / (rest + weights.sum(-1, keepdim=True))


@dataclass(frozen=True, eq=False)
class HandOver:
    """The conditioning of one window, whose objects are handed over in every step."""

    net: EchoDenoiser
    features: EchoFeatures
    conditioning: Conditioning
    frame: Rigid

    def corrected(self, x0_hat: Float[Tensor, "batch frame feature"]) -> Float[Tensor, "batch frame feature"]:
        """x̂0 whose object is where the wrists have it that hold it. Observed contacts are what they were observed to be,
        others the network's."""
        given = self.conditioning
        mean, scale = self.net.motion_normalizer.mean.to(x0_hat), self.net.motion_normalizer.scale.to(x0_hat)
        _, scene_object, contact = (x0_hat * scale + mean).split(self.net.sizes, -1)
        prob = torch.where(given.is_observed[..., 2:], given.contact, (contact + 1) / 2)
        weights = in_hand(prob, given.has_object, given.valid)
        frames = self.features.object_frames(given.points, self.frame)
        own = slice(self.net.sizes[0], self.net.sizes[0] + OBJECT_SIZE)
        corrected = x0_hat.clone()
        corrected[..., own] = (handed_over(self.features, scene_object, frames, weights) - mean[own]) / scale[own]
        return corrected
