"""What must be known of a wearer before the capture starts, and its file from one time to the next."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class Seat:
    """How a device sits on a joint: p_joint = R_joint_device p_device + t_joint_device (m)."""

    joint: str
    """"head", "left_wrist" or "right_wrist"."""
    R_joint_device: Float[Tensor, "3 3"]
    t_joint_device: Float[Tensor, "3"]
    yaw_rad: float = 0.0
    """Turn about the vertical from the device's own world to the head's, for watches, whose heading is arbitrary."""


@dataclass(frozen=True, eq=False)
class Setup:
    """What the first minute finds, or a user gives, of one wearer."""

    skeleton: Skeleton
    """With the wearer's height."""
    seats: Mapping[str, Seat] = field(default_factory=dict)
    """By device, as packets name them."""
    floor_m: float | None = None
    """Floor height (m) in the head's world; None: the session estimates it."""
    notes: tuple[str, ...] = ()
    """How each value was found, as sentences for the page and the report."""
