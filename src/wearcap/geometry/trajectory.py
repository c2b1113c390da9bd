"""Timed poses of one body: resampling, velocities, outliers, smoothing."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.geometry.rigid import Rigid


@dataclass(frozen=True)
class Trajectory:
    """Poses of a body in the world over time (timestamps in s, rising; translations in m)."""

    timestamps: Float64[Tensor, "time"]
    R_world_body: Float[Tensor, "time 3 3"]
    t_world_body: Float[Tensor, "time 3"]

    @property
    def T_world_body(self) -> Rigid:
        return Rigid(self.R_world_body, self.t_world_body)

    def __len__(self) -> int:
        return len(self.timestamps)


def finite_difference(
    value: Float[Tensor, "time *rest"], timestamps: Float64[Tensor, "time"]
) -> Float[Tensor, "time *rest"]:
    """Backward difference per second; the first frame repeats the second's (one frame: zero)."""
    if len(value) < 2:
        return torch.zeros_like(value)
    dt = timestamps.diff().to(value.dtype).reshape(-1, *[1] * (value.ndim - 1))
    velocity = value.diff(dim=0) / dt
    return torch.cat([velocity[:1], velocity])
