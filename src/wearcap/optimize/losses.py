"""Robust losses ρ that map residuals to energy: `Loss`.

A residual is one vector per frame, pair of frames or patch vertex. The thesis's energies of HPS are means of residual norms
(`Loss("norm")`); other losses are ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError

LOSSES = ("norm", "square", "huber", "cauchy")


@dataclass(frozen=True)
class Loss:
    """Loss ρ of a residual's norm s: s; s²; s²/2δ up to δ and s − δ/2 beyond; or δ/2 · log(1 + (s/δ)²)."""

    kind: str
    """One of `LOSSES`, in the order of the formulas above."""
    delta: float = 1.0
    """Norm δ at which "huber" and "cauchy" change from quadratic to robust, in the residual's unit."""

    def __post_init__(self):
        if self.kind not in LOSSES:
            raise WearcapError(f"no loss {self.kind!r}", expected=f"one of {', '.join(LOSSES)}")
        if not self.delta > 0:
            raise WearcapError(f"a loss with delta {self.delta}", expected="a positive number")

    def __call__(self, residual: Float[Tensor, "*batch component"]) -> Float[Tensor, "*batch"]:
        """ρ of each residual; the gradient is finite at zero."""
        square = (residual**2).sum(-1)
        if self.kind == "square":
            return square
        if self.kind == "cauchy":
            return 0.5 * self.delta * torch.log1p(square / self.delta**2)
        norm = torch.where(square > 0, square, 1.0).sqrt() * (square > 0)
        if self.kind == "norm":
            return norm
        return torch.where(norm < self.delta, square / (2 * self.delta), norm - self.delta / 2)
