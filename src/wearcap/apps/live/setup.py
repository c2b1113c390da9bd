"""What must be known of a wearer before the capture starts, and its file from one time to the next.

The file is JSON: {"wearcap_setup": 1, "skeleton": {"name", "joint_names", …}, "floor_m", "notes",
"seats": {DEVICE: {"joint", "R_joint_device_wxyz", "t_joint_device", "yaw_rad"}}}; rotations are unit quaternions, scalar
first.
"""

import json
import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton, skeleton_of_height
from wearcap.boundary.opening import placed, understood
from wearcap.boundary.texts import read_json_object, require_layout
from wearcap.files import write_text
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.io.devices.aria_mps import T_HEAD_DEVICE
from wearcap.io.devices.hand_seats import palm_of, wrist_of_hand
from wearcap.runtime.graphs import SkeletonEntry, skeleton_to_json

MAX_SEATS, MAX_JOINTS, MAX_NOTES = 64, 256, 100
"""Most seats, joints and notes of a file."""
_EXPECTED = "the file that wearcap live wrote with setup=FILE"
_Part = Annotated[float, msgspec.Meta(ge=-1.01, le=1.01)]
_Metre = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]


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

    def with_height(self, height_m: float) -> "Setup":
        """The same of somebody of another height (m). Raises WearcapError for a height that is no person's."""
        if abs(height_m - self.skeleton.stature) < 5e-4:
            return self
        note = f"Height: {height_m:.2f} m, as given, instead of {self.skeleton.stature:.2f} m."
        return replace(self, skeleton=skeleton_of_height(height_m, self.skeleton), notes=(*self.notes, note))


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of wearers before they come."""

    setup: Setup | None = None
    """Of everyone; None: the first minute finds it."""
    height_m: float | None = None
    hands: str = "grip"
    """What hand poses are (`hand_seat`), or "auto"."""
    guided: bool = False
    """Whether everyone begins with the guided first minute."""
    file: Path | None = None
    """Where what the first minute finds is kept; that of a named wearer, under the name beside it."""

    def file_of(self, wearer: str) -> Path | None:
        file = self.file
        return file if file is None or not wearer else file.with_stem(f"{file.stem}_{plain_name(wearer)}")

    def of(self, wearer: str) -> Setup | None:
        """A wearer's set-up as far as it is known. Raises WearcapError as `read_setup` does."""
        file = self.file_of(wearer)
        setup = read_setup(file) if wearer and file is not None and file.is_file() else self.setup
        return setup if setup is None or self.height_m is None else setup.with_height(self.height_m)


def plain_name(wearer: str) -> str:
    """A wearer's name as part of a file's or folder's name: names from the network are no paths.

    A name that has to be changed ends with a checksum, so that names that look alike remain different.
    """
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", wearer)[:40] or "wearer"
    return plain if plain == wearer or not wearer else f"{plain}_{zlib.crc32(wearer.encode('utf-8', 'replace')):08x}"


def head_seat() -> Seat:
    """Nominal seat of glasses and headsets."""
    return Seat("head", T_HEAD_DEVICE.R.float().clone(), T_HEAD_DEVICE.t.float().clone())


def hand_seat(joint: str, kind: str) -> Seat:
    """Nominal seat of what the hand holds, by family of `hand_seats.SEATS`; "joint" is the wrist joint itself."""
    if kind == "joint":
        return Seat(joint, torch.eye(3), torch.zeros(3))
    R_joint_hand = wrist_of_hand(torch.eye(3)[None], joint, kind)[0].mT.contiguous()
    return Seat(joint, R_joint_hand, palm_of(joint, kind))


class _Seat(msgspec.Struct):
    """A seat in a file; the rotation is a unit quaternion."""

    joint: Literal["head", "left_wrist", "right_wrist"]
    R_joint_device_wxyz: Annotated[tuple[_Part, ...], msgspec.Meta(min_length=4, max_length=4)]
    t_joint_device: tuple[_Metre, _Metre, _Metre]
    yaw_rad: Annotated[float, msgspec.Meta(ge=-2 * math.pi, le=2 * math.pi)]

    def seat(self) -> Seat:
        """Raises ValueError for a quaternion that is none."""
        wxyz = torch.tensor(self.R_joint_device_wxyz, dtype=torch.float64)
        if not abs(wxyz.norm().item() - 1) <= 0.01:
            raise ValueError("R_joint_device_wxyz is no unit quaternion")
        return Seat(self.joint, matrix_from_quat_wxyz(wxyz).float(), torch.tensor(self.t_joint_device), self.yaw_rad)


class _File(msgspec.Struct):
    """Layout of a file."""

    wearcap_setup: Literal[1]
    skeleton: SkeletonEntry
    floor_m: Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)] | None
    seats: Annotated[dict[str, _Seat], msgspec.Meta(max_length=MAX_SEATS)]
    notes: Annotated[list[str], msgspec.Meta(max_length=MAX_NOTES)]


def write_setup(setup: Setup, path: str | Path) -> None:
    """Write a setup, atomically."""
    seats = {}
    for device, seat in setup.seats.items():
        wxyz = quat_wxyz_from_matrix(seat.R_joint_device.double()).tolist()
        seats[device] = _Seat(seat.joint, tuple(wxyz), tuple(seat.t_joint_device.tolist()), seat.yaw_rad)
    content = msgspec.to_builtins(
        {"wearcap_setup": 1, "skeleton": skeleton_to_json(setup.skeleton), "floor_m": setup.floor_m, "seats": seats}
    )
    write_text(path, json.dumps(content | {"notes": list(setup.notes)}, indent=1, allow_nan=False) + "\n")


def read_setup(path: str | Path) -> Setup:
    """What `write_setup` wrote. Raises WearcapError for a file that is no setup."""
    content, fix = read_json_object(path), "Do the first minute again, or delete the file."
    with placed(path), understood("not a setup of a wearer", path, _EXPECTED, fix):
        found = require_layout(content, _File, path)
        skeleton = found.skeleton.skeleton()
        if "head" not in skeleton or len(skeleton) > MAX_JOINTS or not 0.5 <= skeleton.stature <= 2.6:
            raise ValueError(f"a skeleton without a head, or {skeleton.stature:.2f} m high")
        seats = {device: seat.seat() for device, seat in found.seats.items()}
        return Setup(skeleton, seats, found.floor_m, tuple(found.notes))
