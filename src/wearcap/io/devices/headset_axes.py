"""Headsets' poses in wearcap's axes: order of quaternions, axes of world and devices, and what poses of hands are of."""

from dataclasses import dataclass

import numpy as np
import torch

from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.conventions import AUTO, Conventions
from wearcap.io.devices.axes import detected_convention, turned, wrist_of_hand
from wearcap.io.devices.headset_tables import RawPoses

PALM_M = 0.08
"""Distance (m) of a held controller's origin, the palm's middle, from the wrist (nominal)."""
ORDERS = ("xyzw", "wxyz")


@dataclass(frozen=True)
class HeadsetLog:
    """Paths of a headset and of the wearer's wrists in wearcap's axes, and how the log was understood."""

    head: Trajectory
    wrists: dict[str, Trajectory]
    """By joint; those that the log has."""
    axes: str
    floor: bool
    """Whether the world's origin lies on the floor, as the head's height shows."""
    notes: tuple[str, ...]
    """What was detected or left out, a sentence each."""


def _order(head: np.ndarray, given: str) -> tuple[str, list[str]]:
    if given != AUTO:
        return given, [f"quaternions {given} as given"]
    upright = {}
    for order in ORDERS:
        x, z = (head[:, order.index(axis)] for axis in "xz")
        upright[order] = float((1 - 2 * (x**2 + z**2)).mean())
    best = max(ORDERS, key=lambda order: upright[order])
    return best, [f"quaternions {best} (the head is upright by {upright[best]:.2f}, else {min(upright.values()):.2f})"]


def in_our_axes(poses: dict[str, RawPoses], how: Conventions, where: str, convention: str | None = None) -> HeadsetLog:
    """Everything in wearcap's axes, hands as wrists, with the notes on what was detected."""
    notes: list[str] = []
    order = poses["head"].order
    if poses["head"].rotation.ndim == 2 and order is None:
        order, notes = _order(poses["head"].rotation, how.quaternion)
    tracks = {}
    for joint, pose in poses.items():
        if pose.rotation.ndim == 3:
            R = torch.tensor(pose.rotation)
        else:
            quat = pose.rotation / np.linalg.norm(pose.rotation, axis=1, keepdims=True)
            R = matrix_from_quat_wxyz(torch.tensor(quat[:, [(order or "xyzw").index(axis) for axis in "wxyz"]]))
        tracks[joint] = Trajectory(
            torch.tensor(pose.seconds), R.float(), torch.tensor(pose.position, dtype=torch.float32)
        )
    held = {joint: track for joint, track in tracks.items() if joint != "head"}
    axes = convention or how.axes
    if axes == AUTO:
        axes, evidence = detected_convention(tracks["head"], held, where)
        notes.insert(0, f"axes {axes}: {evidence}")
    else:
        notes.insert(0, f"axes {axes} as given")
    head, wrists = turned(tracks["head"], axes), {}
    for joint, track in held.items():
        kind = how.hands if how.hands != AUTO else poses[joint].kind or "grip"
        moved = turned(track, axes)
        R = wrist_of_hand(moved.R_world_body, joint, kind)
        t = moved.t_world_body - (PALM_M * moved.R_world_body[:, :, 2] if kind == "grip" else 0.0)
        wrists[joint] = Trajectory(moved.timestamps, R, t)
        notes.append(f"{joint} from {'the hand joint' if kind == 'wrist' else 'the controller (grip pose)'}")
    height = float(np.percentile(head.t_world_body[:, 2].numpy(), 90))
    floor = 0.9 < height < 2.2
    notes.append("the origin is on the floor" if floor else "the origin is not on the floor")
    return HeadsetLog(head, wrists, axes, floor, tuple(notes))
