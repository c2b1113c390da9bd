"""Base class of the networks that predict hand contact from poses (thesis §5.3.2)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

REACH = 30
"""Number of context frames (at 60 Hz) on each side of a predicted frame."""
FRAMES = 2 * REACH + 1


class ContactNetwork(nn.Module):
    """Maps poses of consecutive frames to contact logits per hand (left, right) and class of interaction.

    Of `time` frames, those from `REACH` to `time - REACH - 1` have a prediction; the others lack context.
    """

    temperature: Tensor
    frames_per_pass: int
    """Number of predicted frames that are best computed in one pass."""

    def __init__(self, classes: int):
        super().__init__()
        self.classes = classes
        self.register_buffer("temperature", torch.ones(classes))

    def forward(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        raise NotImplementedError

    def probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        """Calibrated probabilities: sigmoid of the logits divided by a temperature fitted on validation data."""
        return (self(pose) / self.temperature).sigmoid()

    def middle_probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch hand class"]:
        """Calibrated probabilities of the middle one of 61 frames."""
        return self.probability(pose)[:, 0]

    def normalize_on(self, pose: Float[Tensor, "batch time feature"]) -> None:
        """Set the statistics that normalise the inputs; the thesis's network has none."""


def fit_temperature(
    logits: Float[Tensor, "sample class"], truth: Bool[Tensor, "sample class"]
) -> Float[Tensor, "class"]:
    """Temperatures (1/5 … 5) with the least cross-entropy, one per class (Guo et al. 2017); 1 where a class never occurs."""
    candidates = torch.linspace(-1.6, 1.6, 161, device=logits.device).exp()
    target = truth.to(logits.dtype)
    losses = torch.stack(
        [F.binary_cross_entropy_with_logits(logits / t, target, reduction="none").mean(0) for t in candidates]
    )
    best = candidates[losses.argmin(0)]
    return torch.where(truth.any(0), best, torch.ones_like(best)).to(logits.dtype)
