"""Headsets' axes, units and orders of quaternions: written by SciPy in every convention, read as the same wearer or asked."""

import csv
import io
import lzma

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.devices.headset_axes import HeadsetLog, in_our_axes
from wearcap.io.devices.headset_tables import RawPoses

TO_OURS = {
    "openxr": np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "unity": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "unreal": np.diag([1.0, -1.0, 1.0]),
    "head": np.eye(3),
}
"""Columns: a convention's axes, ahead, left and up."""
POSTURES = {
    "ahead": (5, (0.35, 0.2, -0.35), True),
    "hanging": (5, (0.05, 0.25, -0.7), True),
    "behind": (18, (-0.12, 0.2, -0.65), True),
    "down": (52, (0.0, 0.25, -0.7), True),
    "far down": (74, (0.1, 0.25, -0.7), True),
    "standing": (8, (0.1, 0.25, -0.7), False),
    "standing, behind": (20, (-0.14, 0.2, -0.65), False),
}
"""Pitch (degrees down), the left hand seen from the neck (m; ahead, left, up), and whether the wearer walks."""
PER_UNIT = {"m": 1.0, "cm": 100.0, "mm": 1000.0}


def wearer(posture: str, seconds: float = 12.0, fps: float = 60.0):
    """Times (s), and {joint: (rotations, places in m)} of somebody whose head turns on a neck; x ahead, y left, z up."""
    pitch, (ahead, aside, below), walks = POSTURES[posture]
    time = np.arange(int(seconds * fps)) / fps
    course = 0.25 * time + 0.3 * np.sin(0.5 * time) if walks else 0.1 * np.sin(0.4 * time)
    step = np.stack([np.cos(course), np.sin(course)], 1) * 1.1 * walks / fps
    neck = np.concatenate([np.cumsum(step, 0), 1.52 + 0.015 * walks * np.sin(11 * time)[:, None]], 1)
    turn = np.stack(
        [
            course + 0.4 * np.sin(1.3 * time),
            np.radians(pitch) + 0.12 * np.sin(2.1 * time),
            0.05 * np.sin(1.7 * time),
        ],
        1,
    )
    head, body = Rotation.from_euler("ZYX", turn), Rotation.from_euler("z", course[:, None])
    poses = {"head": (head.as_matrix(), neck + head.apply([0.1, 0.0, 0.1]))}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = 0.12 * walks * np.sin(5.5 * time + sign)
        at = np.stack([ahead + swing, sign * aside + 0 * time, below + 0 * time], 1)
        arm = Rotation.from_euler("ZYX", np.stack([0.2 * sign + 0 * time, 0.9 + swing, 0.1 * sign + swing], 1))
        poses[f"{side}_wrist"] = (body * arm).as_matrix(), neck + body.apply(at)
    return time, poses


def written(time, poses, convention: str, order: str, unit: str, named: bool = False) -> dict[str, RawPoses]:
    """Poses as a file has them."""
    M, found = TO_OURS[convention], {}
    for joint, (R, t) in poses.items():
        quat = Rotation.from_matrix(M.T @ R @ M).as_quat()[:, ["xyzw".index(axis) for axis in order]]
        found[joint] = RawPoses(time, t @ M * PER_UNIT[unit], quat, order if named else None, "grip")
    return found


def assert_is(found: HeadsetLog, poses, convention: str) -> None:
    """The head and the hands' palms are where they were made (1 mm, 0.1°)."""
    assert found.axes == convention
    R, t = poses["head"]
    assert np.abs(found.head.t_world_body.numpy() - t).max() < 1e-3
    off = Rotation.from_matrix(np.swapaxes(found.head.R_world_body.double().numpy(), 1, 2) @ R).magnitude()
    assert np.degrees(off.max()) < 0.1
    for joint, wrist in found.wrists.items():
        assert np.linalg.norm(wrist.t_world_body.numpy() - poses[joint][1], axis=1).max() == pytest.approx(0.08, abs=1e-3)


@pytest.mark.parametrize("posture", POSTURES)
@pytest.mark.parametrize("convention", TO_OURS)
@pytest.mark.parametrize("unit", PER_UNIT)
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_every_reading_is_right_or_asked(posture, convention, unit, order):
    """Neither order, axes nor unit are named; only who stands with the hands behind the back may be asked."""
    time, poses = wearer(posture)
    raw = written(time, poses, convention, order, unit)
    try:
        found = in_our_axes(raw, Conventions(), "log")
    except WearcapError as error:
        assert posture == "standing, behind"
        assert f"axes={convention}" in str(error) or f"|{convention}" in str(error)
        found = in_our_axes(raw, Conventions(axes=convention, quaternion=order), "log")
    assert_is(found, poses, convention)
    notes = "\n".join(found.notes)
    assert f"axes {convention}" in notes
    assert f"quaternions {order}" in notes
    assert ("unit" in notes) == (unit != "m")
    assert found.floor
