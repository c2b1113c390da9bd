"""Who wears the devices of a streaming capture, and how."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class Wearer:
    """The wearer's body and the mounting of the devices; each system reads what it uses."""

    skeleton: Skeleton
    R_head_device: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3))
    t_head_device: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3))
    R_wrist_imu: Mapping[str, Float[Tensor, "3 3"]] = field(default_factory=dict)
    """Mounting of each watch on its wrist joint; identity where missing (MocapEvery)."""
    floor_m: float | None = None
    """World z of the floor, for MocapEvery the initial one (the paper's h_0); None: estimated from the head's path and the
    height of a standing head, which in a stream uses earlier frames only. HMD² takes floors from samples instead."""
    shape: Mapping[str, float] = field(default_factory=dict)
    """Of the body's surface (ECHO)."""
