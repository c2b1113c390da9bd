"""What the networks that tell hand contact from poses have in common (thesis §5.3.2)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

REACH = 30
"""Frames (at 60 Hz) that a prediction looks back, and ahead."""
FRAMES = 2 * REACH + 1


class ContactNetwork(nn.Module):
    """Poses of consecutive frames to logits of contact, per hand (left, right) and class of interaction.

    Of `time` frames those from `REACH` to `time - REACH - 1` have an answer: the others lack neighbours.
    """

    temperature: Tensor
    frames_per_pass: int
    """Answers that are best computed together."""

    def __init__(self, classes: int):
        super().__init__()
        self.classes = classes
        self.register_buffer("temperature", torch.ones(classes))

    def forward(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        raise NotImplementedError

    def probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        """Calibrated probabilities: the logits are divided by a temperature that was fitted on validation data."""
        return (self(pose) / self.temperature).sigmoid()

    def normalize_on(self, pose: Float[Tensor, "batch time feature"]) -> None:
        """Take the statistics that inputs are normalised with; the document's network has none."""


def fit_temperature(
    logits: Float[Tensor, "sample class"], truth: Bool[Tensor, "sample class"]
) -> Float[Tensor, "class"]:
    """Temperatures (1/5 … 5) with the least cross-entropy, one per class (Guo et al. 2017); 1 where a class never occurs."""
    candidates = torch.linspace(-1.6, 1.6, 161, device=logits.device).exp()
    target = truth.to(logits.dtype)
    losses = torch.stack([
        F.binary_cross_entropy_with_logits(logits / t, target, reduction="none").mean(0) for t in candidates
    ])  # fmt: skip
    best = candidates[losses.argmin(0)]
    return torch.where(truth.any(0), best, torch.ones_like(best)).to(logits.dtype)
