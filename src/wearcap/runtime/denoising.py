"""Fast denoising steps: what depends on the noise levels alone is computed once per level.

A denoiser has `plan(level) -> LevelPlan` and `step(x_t, plan, encoded, valid[, last])`. The graphs pass a plan as one
tensor of columns.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


class LevelPlan(NamedTuple):
    """The part of a denoising step that depends on the noise levels alone."""

    worth: tuple[Float[Tensor, "batch #token width"], ...]
    """Per-channel scale of the encoded x_t, for each encoder of the motion (`MotionEncoder.plan`)."""
    blocks: tuple[Float[Tensor, "batch #token modulation"], ...]
    """Modulation of every adaptive transformer block."""


class PlanGraph(nn.Module):
    """A plan's columns from levels."""

    def __init__(self, net: Any):
        super().__init__()
        self.net = net

    def forward(self, level: Float[Tensor, "batch *token"]) -> Float[Tensor, "batch #token column"]:
        plan = self.net.plan(level)
        return torch.cat([*plan.worth, *plan.blocks], -1)


class StepGraph(nn.Module):
    """x̂0 from x_t and a plan's columns."""

    def __init__(self, net: Any, level: Float[Tensor, "batch *token"]):
        """`level`: any levels, of the shape that `net.plan` takes."""
        super().__init__()
        self.net = net
        with torch.no_grad():
            plan = net.plan(level)
        self._worths = len(plan.worth)
        self._sizes = [part.shape[-1] for part in (*plan.worth, *plan.blocks)]

    @property
    def columns(self) -> int:
        """Columns of a plan."""
        return sum(self._sizes)

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        plan: Float[Tensor, "#batch #token column"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """`last`: x̂0 of the previous step, for a network with self-conditioning."""
        parts = plan.split(self._sizes, -1)
        more = () if last is None else (last,)
        return self.net.step(x_t, LevelPlan(parts[: self._worths], parts[self._worths :]), encoded, valid, *more)
