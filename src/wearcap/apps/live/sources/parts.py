"""What the sources share: checked poses in wearcap's axes, names of devices, options of addresses."""

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.apps.live.packets import CAMERA, HEAD, SUIT
from wearcap.apps.live.recent import Entry, Recent
from wearcap.apps.live.source import Fault, require
from wearcap.body.skeleton import WRISTS
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.headset_axes import CONVENTIONS
from wearcap.sensors.packets import MAX_POSITION_M, NOT_A_ROTATION, NOT_FINITE, rotation_fault, values_fault

MAX_NAME = 64
"""Characters of a device's or wearer's name."""
MAX_NAMES = 64
"""Names that a source knows at once."""
UNIT_TOLERANCE = 0.02
"""Tolerance of a quaternion's length."""
AXES = {"wearcap": torch.eye(3), **CONVENTIONS}
"""Rotations or reflections into wearcap's axes (x forward, y left, z up), by name."""
_OTHER_PARTS = re.compile("foot|feet|ankle|toe|knee|leg|thigh|hip|elbow|arm(?!and)|shoulder|chest|waist|eye|ear")

UNTRACKED = "not tracked"
TOO_MANY_NAMES = "too many devices"
BAD_NAME = "no name"


class Names(Recent[Entry]):
    """What a source keeps by names that come from the network, bounded in number and length."""

    def __init__(self, make: Callable[[str], Entry] = lambda name: None):
        super().__init__(MAX_NAMES, make)

    def entry(self, name: Any, now_s: float) -> Entry:
        """What is kept by a name. Raises Fault for a name that cannot be used."""
        if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME or not name.isprintable():
            raise Fault(BAD_NAME)
        self.admit(name, now_s)
        require(None if name in self else TOO_MANY_NAMES)
        return self[name]


def device_of(serial: str) -> str:
    """The wrist that a serial plainly names ("LeftHand", "Controller (Right)"), else the serial itself.

    A serial that is the name of another kind of device gets another name.
    """
    if serial in (HEAD, SUIT, CAMERA):
        return f"tracker {serial}"
    name = serial.lower()
    left, right = "left" in name, "right" in name
    if left == right or _OTHER_PARTS.search(name):
        return serial
    return WRISTS[0] if left else WRISTS[1]


def pose_of(position: Sequence[float], quat_wxyz: Sequence[float], axes: str) -> Rigid:
    """A pose of named axes, world and device alike, in wearcap's. Raises Fault for one that is none."""
    return checked_pose(position, matrix_of(quat_wxyz), axes)


def matrix_of(quat_wxyz: Sequence[float]) -> Float[Tensor, "3 3"]:
    """Rotation matrix of a quaternion of about unit length. Raises Fault for another one."""
    w, x, y, z = quat_wxyz
    square = w * w + x * x + y * y + z * z
    if not abs(square - 1) <= 2 * UNIT_TOLERANCE:
        raise Fault(NOT_A_ROTATION if math.isfinite(square) else NOT_FINITE)
    s = 2 / square
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return torch.tensor(rows)


def checked_pose(position: Sequence[float], R: Float[Tensor, "3 3"], axes: str) -> Rigid:
    """As `pose_of`, of a matrix."""
    t = torch.tensor(position, dtype=torch.float32)
    require(rotation_fault(R) or values_fault(t, (3,), MAX_POSITION_M))
    M = AXES[axes]
    return Rigid(R, t) if axes == "wearcap" else Rigid(M @ R @ M.T, M @ t)


def untracked(position: Sequence[float], quat_wxyz: Sequence[float]) -> bool:
    """Whether a pose is what runtimes send for a device that they do not see: all zero, or zero and unturned."""
    return not any(position) and not any(quat_wxyz[1:])
