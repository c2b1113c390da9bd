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
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import WRISTS, Site, Skeleton, skeleton_of_height
from wearcap.boundary.opening import placed, understood
from wearcap.boundary.texts import read_json_object
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.io.devices.aria_mps import T_HEAD_DEVICE
from wearcap.io.devices.headset_axes import palm_of, wrist_of_hand

MAX_SEATS, MAX_JOINTS, MAX_NOTES = 64, 256, 100
"""Most seats, joints and notes of a file."""
_VERSION = 1
_EXPECTED = "the file that wearcap live wrote with setup=FILE"


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
    """What hand poses are (`hand_seat`)."""
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
    """Nominal seat of what the hand holds: "grip" or "pointer" (a controller), "wrist" (OpenXR's hand joint), "joint" (ours)."""
    if kind == "joint":
        return Seat(joint, torch.eye(3), torch.zeros(3))
    R_joint_hand = wrist_of_hand(torch.eye(3)[None], joint, kind)[0].mT.contiguous()
    return Seat(joint, R_joint_hand, palm_of(joint, kind))


def write_setup(setup: Setup, path: str | Path) -> None:
    """Write a setup, atomically."""
    skeleton = setup.skeleton
    content = {
        "wearcap_setup": _VERSION,
        "skeleton": {
            "name": skeleton.name,
            "joint_names": list(skeleton.joint_names),
            "parents": list(skeleton.parents),
            "t_parent_joint": skeleton.t_parent_joint.tolist(),
            "sites": {name: [site.joint, *site.t_joint_site] for name, site in skeleton.sites.items()},
        },
        "floor_m": setup.floor_m,
        "seats": {device: _row(seat) for device, seat in setup.seats.items()},
        "notes": list(setup.notes),
    }
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_setup(path: str | Path) -> Setup:
    """What `write_setup` wrote. Raises WearcapError for a file that is no setup."""
    content = read_json_object(path)
    fix = "Do the first minute again, or delete the file."
    if content.get("wearcap_setup") != _VERSION:
        raise WearcapError("no setup of a wearer", path, _EXPECTED, fix)
    with placed(path), understood("not a setup of a wearer", path, _EXPECTED, fix):
        floor_m = None if content["floor_m"] is None else _number(content["floor_m"], "floor_m", 1e4)
        seats, notes = content["seats"], content["notes"]
        if not isinstance(seats, dict) or len(seats) > MAX_SEATS:
            raise ValueError("seats by device are missing, or too many")
        if not (isinstance(notes, list) and len(notes) <= MAX_NOTES and all(isinstance(one, str) for one in notes)):
            raise ValueError("notes that are no sentences")
        skeleton = _skeleton(content["skeleton"])
        return Setup(skeleton, {name: _seat(row) for name, row in seats.items()}, floor_m, tuple(notes))


def _row(seat: Seat) -> dict[str, Any]:
    return {
        "joint": seat.joint,
        "R_joint_device_wxyz": quat_wxyz_from_matrix(seat.R_joint_device.double()).tolist(),
        "t_joint_device": seat.t_joint_device.tolist(),
        "yaw_rad": seat.yaw_rad,
    }


def _seat(row: dict[str, Any]) -> Seat:
    if row["joint"] not in ("head", *WRISTS):
        raise ValueError(f"a seat on {str(row['joint'])[:30]!r}")
    wxyz = torch.tensor(_numbers(row["R_joint_device_wxyz"], 4, "R_joint_device_wxyz", 1.01), dtype=torch.float64)
    if abs(wxyz.norm().item() - 1) > 0.01:
        raise ValueError("R_joint_device_wxyz is no unit quaternion")
    t = torch.tensor(_numbers(row["t_joint_device"], 3, "t_joint_device", 1.0))
    R = matrix_from_quat_wxyz(wxyz).float()
    return Seat(row["joint"], R, t, _number(row["yaw_rad"], "yaw_rad", 2 * math.pi))


def _skeleton(row: dict[str, Any]) -> Skeleton:
    names, parents, offsets, sites = (row[key] for key in ("joint_names", "parents", "t_parent_joint", "sites"))
    if not (isinstance(names, list) and 0 < len(names) <= MAX_JOINTS and len(sites) <= MAX_JOINTS):
        raise ValueError("a skeleton without joints, or with too many")
    if not all(isinstance(name, str) for name in (row["name"], *names)):
        raise ValueError("joints without names")
    if not (isinstance(parents, list) and all(type(parent) is int for parent in parents)):
        raise ValueError("parents that are no joints' numbers")
    t_parent_joint = torch.tensor([_numbers(offset, 3, "t_parent_joint", 10.0) for offset in offsets])
    places = {name: (row[0], _numbers(row[1:], 3, f"site {name[:30]}", 10.0)) for name, row in sites.items()}
    if unknown := next((joint for joint, _ in places.values() if joint not in names), None):
        raise ValueError(f"a site on {str(unknown)[:30]!r}")
    found = {name: Site(joint, (t[0], t[1], t[2])) for name, (joint, t) in places.items()}
    skeleton = Skeleton(row["name"], tuple(names), tuple(parents), t_parent_joint, found)
    if "head" not in skeleton or not 0.5 <= skeleton.stature <= 2.6:
        raise ValueError(f"a skeleton without a head, or {skeleton.stature:.2f} m high")
    return skeleton


def _number(value: Any, name: str, limit: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= limit:
        raise ValueError(f"{name} of {str(value)[:30]}")
    return float(value)


def _numbers(values: Any, count: int, name: str, limit: float) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{name} is no list of {count} numbers")
    return [_number(value, name, limit) for value in values]
