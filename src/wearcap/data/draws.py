"""Random numbers of training windows: functions of each window's seed and of a name, the same on every device.

They are counted, not taken in turn (Salmon et al. 2011): the k-th number of a name is a hash of seed, name and k. A sample
thus depends neither on the batch that it is drawn in nor on which other numbers are used.
"""

import zlib
from functools import cache

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from wearcap.data import kernels

_GOLDEN = -7046029254386353131
"""2^64 divided by the golden ratio, as a signed number: the step of SplitMix64 (Steele et al. 2014)."""
_MIX = (30, -4658895280553007687), (27, -7723592293110705685), (31, 1)
"""Shifts and factors of SplitMix64's mixing of 64 bits."""
_LEVELS = 1 << 16
"""Number of values that a normal number can have: equally likely quantiles of the distribution."""


class Draws:
    """Random numbers of the windows of a batch."""

    def __init__(self, seed: Int64[Tensor, "batch"]):
        self.seed = _mixed(seed * _GOLDEN)

    def _bits(self, name: str, count: int) -> Int64[Tensor, "batch draw"]:
        """64 random bits for each number."""
        key = _mixed(self.seed ^ _number(name))[:, None]
        return _mixed(key + torch.arange(1, count + 1, device=self.seed.device) * _GOLDEN)

    def uniform(self, name: str, *shape: int) -> Float[Tensor, "batch *shape"]:
        """Uniform numbers in [0, 1)."""
        count = torch.Size(shape).numel()
        if self.seed.device.type == "cpu":
            found = torch.empty(len(self.seed), count)
            kernels.uniforms(self.seed.numpy(), _number(name), found.numpy())
        else:
            found = ((self._bits(name, count) >> 40) & 0xFFFFFF).float() * 2.0**-24
        return found.reshape(-1, *shape)

    def share(self, name: str) -> Float64[Tensor, "batch"]:
        """Uniform numbers in [0, 1) of double precision, to choose among many."""
        return ((self._bits(name, 1)[:, 0] >> 11) & (2**53 - 1)).double() * 2.0**-53

    def normal(self, name: str, *shape: int) -> Float[Tensor, "batch *shape"]:
        """Normal numbers of unit deviation, of 65,536 values up to 4.2."""
        count = torch.Size(shape).numel()
        table, words = _quantiles(self.seed.device), -(-count // 4)
        if self.seed.device.type == "cpu":
            found = torch.empty(len(self.seed), 4 * words)
            kernels.normals(self.seed.numpy(), _number(name), table.numpy(), found.numpy())
        else:
            found = table[self._bits(name, words).view(torch.int16).long()]
        return found[:, :count].reshape(-1, *shape)


@cache
def _number(name: str) -> int:
    return zlib.crc32(name.encode())


def _mixed(bits: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
    """SplitMix64's output function; products are modulo 2^64."""
    for shift, factor in _MIX:
        bits = (bits ^ ((bits >> shift) & ((1 << (64 - shift)) - 1))) * factor
    return bits


@cache
def _quantiles(device: torch.device) -> Float[Tensor, "level"]:
    """Quantiles of the normal distribution in the order of 16-bit numbers, negative indices last."""
    share = (torch.arange(_LEVELS, dtype=torch.float64) + 0.5) / _LEVELS
    value = 2**0.5 * torch.erfinv(2 * share - 1)
    return (value / value.square().mean().sqrt()).float().to(device)
