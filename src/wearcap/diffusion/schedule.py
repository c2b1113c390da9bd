"""Noise schedules: the share of signal, ᾱ, that is left at a noise level."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Schedule = Callable[[Float[Tensor, "*batch"]], Float[Tensor, "*batch"]]
"""Maps noise levels in [0, 1] to ᾱ, falling from 1 to about 0."""


class CosineSchedule:
    """ᾱ(l) = cos²(π/2 · (l + s) / (1 + s)), scaled so that ᾱ(0) = 1 (Nichol & Dhariwal 2021)."""

    def __init__(self, offset: float = 0.008):
        self.offset = offset

    def __call__(self, level: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        start = math.cos(math.pi / 2 * self.offset / (1 + self.offset)) ** 2
        return torch.cos(math.pi / 2 * (level + self.offset) / (1 + self.offset)) ** 2 / start
