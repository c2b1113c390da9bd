"""Axes of foreign worlds and devices: named conventions, and which of them a path of poses shows.

A convention is the rotation, or for left-handed ones the reflection, that takes its coordinates to wearcap's: x forward,
y left, z up. World and device share it, so a pose is turned on both sides: R = M R' Mᵀ, t = M t'.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory, linear_velocity

OPENXR = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Axes of OpenXR and SteamVR (x right, y up, z back) in the head's."""
UNITY = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Unity's left-handed axes: x right, y up, z forward."""
UNREAL = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
"""Unreal's left-handed axes: x forward, y right, z up."""
UPRIGHT = 0.7
"""Least mean component of a worn device's up axis along the world's."""
CAMERA = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""OpenCV's camera axes (x right, y down, z forward) in the head's (x forward, y left, z up)."""
DEVICES = {"camera": CAMERA, "head": torch.eye(3), "openxr": OPENXR}
"""Axes of a device in the head's, by name."""
WORLDS = {
    "z": torch.eye(3),
    "y": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-z": torch.diag(torch.tensor([1.0, -1.0, -1.0])),
    "x": torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "-x": torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
}
"""Rotations of a right-handed world into one with z up, by the axis that is up; x stays x where it is level."""
_USUAL_WORLDS = ("z", "y", "-y")
"""Those of files that do not say which they have."""
WALKING_M_S = 0.4
_SEEN_S = 2.0
CLEAR = 0.1
"""Lead of the best reading of a path's axes from which it is taken."""
_PATH_M = 0.5
"""Spread of a path from which it counts in full that it is level; a standing wearer's head moves less, in any direction."""


@dataclass(frozen=True)
class DeviceAxes:
    """Axes of a trajectory: the world's up axis and the device's own axes, by the names of `WORLDS` and `DEVICES`."""

    up: str
    device: str
    upright: float
    """Mean component of the device's up axis along the world's."""
    known_by: str
    """Why these were taken, in a few words."""


def device_axes(
    track: Trajectory, up: str = "auto", device: str = "auto", where: str = "", usual: tuple[str, str] | None = None
) -> DeviceAxes:
    """Axes of a worn device's path; those that are "auto" follow from which axis stays upright, and where it goes.

    Each convention scores by how upright the device is, how level its path, and how well its forward axis agrees with the
    walk. Where the best leads by less than `CLEAR`, the format's `usual` axes (up, device) are taken. Raises WearcapError
    for other names, when nothing stays upright, and where several fit alike.
    """
    for name, value, allowed in (("up", up, WORLDS), ("axes", device, DEVICES)):
        if value not in ("auto", *allowed):
            raise WearcapError(f"{name}={value!r}", expected=f"one of auto, {', '.join(allowed)}")
    R, spread = track.R_world_body.double(), track.t_world_body.double().std(0, unbiased=False)
    candidates = []
    for world in _USUAL_WORLDS if up == "auto" else (up,):
        for name, axes in DEVICES.items():
            if device not in ("auto", name):
                continue
            R_up = WORLDS[world]
            upright = (R_up[2].double() @ R.mean(0) @ axes.double()[2]).item()
            flat = 1 - (spread @ R_up[2].double().abs() / spread.norm().clamp_min(1e-9)).item()
            level = 0.3 * flat * min(1.0, spread.norm().item() / _PATH_M)
            candidates.append((upright + level + 0.2 * _ahead(track, R_up, axes), upright, world, name))
    ranked = sorted(candidates, reverse=True)
    score, upright, world, name = ranked[0]
    if upright < UPRIGHT and "auto" in (up, device):
        what = f"no axis of the device stays upright (the best, {name} in a world with {world} up, by {upright:.2f})"
        fix = "Say what is up in the world, and which axes the device has: up=z|y|-y axes=camera|head|openxr."
        raise WearcapError(what, where, f"{UPRIGHT} or more, as worn devices have it", fix)
    alike = [row for row in ranked if row[0] > score - CLEAR and row[1] > UPRIGHT]
    if len(alike) < 2:
        lead = f", {score - ranked[1][0]:.2f} better than any other reading" if len(ranked) > 1 else ""
        return DeviceAxes(world, name, upright, f"the device is upright by {upright:.2f}{lead}")
    for _, upright, world, name in alike:
        if (world, name) == usual:
            return DeviceAxes(world, name, upright, "as the format usually has it; the path does not show it")
    listed = " or ".join(f"up={row[2]} axes={row[3]}" for row in alike)
    raise WearcapError(
        f"{len(alike)} readings of its axes fit alike", where, "one that fits best", f"Say which: {listed}."
    )


def to_head_axes(track: Trajectory, axes: DeviceAxes) -> Trajectory:
    """The path in a world with z up, its device turned to the head's axes."""
    R_up, R_head_device = WORLDS[axes.up].to(track.R_world_body), DEVICES[axes.device].to(track.R_world_body)
    R = R_up @ track.R_world_body @ R_head_device.mT
    return Trajectory(track.timestamps, R, track.t_world_body @ R_up.mT)


def _ahead(track: Trajectory, R_up: Tensor, axes: Tensor) -> float:
    """Mean cosine between the device's forward axis and the walk, -1 … 1; 0 where there is hardly a walk."""
    velocity = linear_velocity(track).double() @ R_up.double().mT
    speed = velocity[:, :2].norm(dim=-1)
    walking = speed > WALKING_M_S
    step = track.timestamps.diff().median().item() if len(track) > 1 else 0.0
    if walking.sum() * step < _SEEN_S:
        return 0.0
    forward = (R_up.double() @ track.R_world_body.double() @ axes.double().mT)[walking][:, :2, 0]
    return (
        (torch.nn.functional.normalize(forward, dim=-1) * velocity[walking, :2] / speed[walking, None])
        .sum(-1)
        .mean()
        .item()
    )
