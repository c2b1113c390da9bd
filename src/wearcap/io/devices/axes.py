"""Axes of foreign worlds and devices: named conventions, and which of them a path of poses shows.

A convention is the rotation, or for left-handed ones the reflection, that takes its coordinates to wearcap's: x forward,
y left, z up. World and device share it, so a pose is turned on both sides: R = M R' Mᵀ, t = M t'.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, linear_velocity

OPENXR = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
UNITY = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
CONVENTIONS = {"unity": UNITY, "openxr": OPENXR, "steamvr": OPENXR}
"""x right, y up; z forward and left-handed in Unity, z backward and right-handed in OpenXR and SteamVR."""
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
_AHEAD_M = 0.05
_AGREEMENT = 0.5
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


def turned(track: Trajectory, convention: str) -> Trajectory:
    """A path of a named convention in wearcap's axes, world and device alike."""
    M = CONVENTIONS[convention].to(track.R_world_body)
    return Trajectory(track.timestamps, M @ track.R_world_body @ M.mT, track.t_world_body @ M.mT)


def detected_convention(head: Trajectory, hands: dict[str, Trajectory], where: str) -> tuple[str, str]:
    """(convention, evidence) of a headset's poses with y up, by where it walks and where the hands are held.

    OpenXR and SteamVR have the same axes. Raises WearcapError when y is not up, and when neither shows forward.
    """
    upright = head.R_world_body[:, 1, 1].double().mean().item()
    if upright < UPRIGHT:
        what = f"the headset's y axis points {upright:.2f} up on average"
        fix = "Check the order of the quaternion (quaternion=xyzw|wxyz), and that y is the world's up axis."
        raise WearcapError(what, where, f"{UPRIGHT} or more", fix)
    velocity, forward = linear_velocity(head).double()[:, [0, 2]], head.R_world_body[:, [0, 2], 2].double()
    speed = velocity.norm(dim=-1)
    walking = speed > WALKING_M_S
    step = head.timestamps.diff().median().item()
    if walking.sum() * step >= _SEEN_S:
        facing = torch.nn.functional.normalize(forward[walking], dim=-1)
        along = (facing * velocity[walking] / speed[walking, None]).sum(-1).mean().item()
        if abs(along) > _AGREEMENT:
            name = "unity" if along > 0 else "openxr"
            return name, f"walks along its {'+' if along > 0 else '-'}z axis (agreement {abs(along):.2f})"
    ahead = [_in_front(head, hand) for hand in hands.values() if len(hand) > 1]
    mean = sum(ahead) / len(ahead) if ahead else 0.0
    if abs(mean) > _AHEAD_M:
        name = "unity" if mean > 0 else "openxr"
        return name, f"hands are held {100 * abs(mean):.0f} cm along its {'+' if mean > 0 else '-'}z axis"
    what = "neither a walk nor the hands show which way the headset looks"
    raise WearcapError(what, where, "2 s of walking ahead", "Say which axes the log has: axes=unity|openxr|steamvr.")


def _in_front(head: Trajectory, hand: Trajectory) -> float:
    """Median distance (m) of a hand along the headset's horizontal z axis."""
    near = torch.searchsorted(head.timestamps, hand.timestamps).clamp(max=len(head) - 1)
    z = torch.nn.functional.normalize(head.R_world_body[near][:, [0, 2], 2].double(), dim=-1)
    return ((hand.t_world_body - head.t_world_body[near])[:, [0, 2]].double() * z).sum(-1).median().item()


def wrist_of_hand(R_world_hand: Float[Tensor, "time 3 3"], joint: str, kind: str) -> Float[Tensor, "time 3 3"]:
    """Rotation of a wrist joint from a hand pose in wearcap's axes (x forward, y left, z up of the device).

    "wrist" is OpenXR's hand joint: forward along the fingers, up out of the hand's back. "grip" is a held controller:
    forward along the fist from little finger to thumb, up along the fingers, x right out of the left hand's back and
    into the right palm. A wrist joint's own axes are the world's in a T-pose that faces x, palms down.
    """
    side = 1.0 if joint.startswith("left") else -1.0
    if kind == "wrist":
        R_joint_hand = rotation.about_axis("z", torch.tensor(side * torch.pi / 2))
    else:  # device axes in a T-pose: forward = x, up (fingers) = ± y, left = ∓ z
        R_joint_hand = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, side], [0.0, -side, 0.0]])
    return R_world_hand @ R_joint_hand.to(R_world_hand).mT
