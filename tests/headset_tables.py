"""One short walk as headsets' logs have it, writers of tables by NumPy and SciPy alone, and the comparison with what is read."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import short_walk
from wearcap.io.devices.headset_log import read_raw_poses

TIME, R, T = short_walk.walk()
POSES = short_walk.headset_poses(TIME, R, T, "unity", "grip")
SIDES = {"head": "head", "left_wrist": "left", "right_wrist": "right"}


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def texts(*parts, digits=7) -> list[list[str]]:
    """Columns of texts or numbers side by side, as rows of texts."""
    columns = [part if isinstance(part, list) else np.asarray(part).reshape(len(part), -1).tolist() for part in parts]
    shown = [
        [[value] if isinstance(value, str) else [f"{number:.{digits}f}" for number in value] for value in column]
        for column in columns
    ]
    return [[field for column in shown for field in column[row]] for row in range(len(shown[0]))]


def csv(path: Path, names: str, *parts, between=",", digits=7) -> Path:
    rows = [between.join(row) for row in texts(*parts, digits=digits)]
    return write(path, "\n".join([names, *rows]) + "\n")


def names_of(pattern: str, devices=("head", "left", "right")) -> str:
    """A header: "{d}_pos_x … {d}_rot_w" of each device."""
    axes = [pattern.format(d=device, q="pos", a=axis) for device in ("{0}",) for axis in "xyz"]
    axes += [pattern.format(d="{0}", q="rot", a=axis) for axis in "xyzw"]
    return ",".join(name.replace("{0}", device) for device in devices for name in axes)


def seven(device: str, scale=1.0) -> np.ndarray:
    turn, at = POSES[device]
    return np.concatenate([at * scale, short_walk.quat_xyzw(turn)], 1)


def all_seven(scale=1.0) -> np.ndarray:
    return np.concatenate([seven(device, scale) for device in POSES], 1)


def matrices(device: str) -> np.ndarray:
    turn, at = POSES[device]
    return np.concatenate([np.concatenate([turn, at[:, :, None]], 2), np.tile([[[0.0, 0, 0, 1]]], (len(at), 1, 1))], 1)


def compare(path: Path, start: float | None = TIME[0], scale=1.0, within=2e-6, late=1e-3, turned=0.02, devices=SIDES):
    """Raw poses as they were written: positions within rounding, times to 1 ms (their difference where no start is known)."""
    poses, _, convention, notes = read_raw_poses(path)
    assert set(poses) == set(devices)
    for joint, device in devices.items():
        pose, (turn, at) = poses[joint], POSES[device]
        expected = TIME - TIME[0] + (pose.seconds[0] if start is None else start)
        assert len(pose.seconds) == len(TIME)
        assert np.abs(pose.seconds - expected).max() < late
        assert np.abs(pose.position - at * scale).max() < within * scale
        found = (
            Rotation.from_quat(
                pose.rotation[:, ["wxyz".index(axis) for axis in "xyzw"]] if pose.order == "wxyz" else pose.rotation
            )
            if pose.rotation.ndim == 2
            else Rotation.from_matrix(pose.rotation)
        )
        assert np.degrees((found.inv() * Rotation.from_matrix(turn)).magnitude()).max() < turned
    return poses, convention, notes


def euler_angles(device: str) -> np.ndarray:
    """Unity's degrees, 0 to 360: about z first, then x, then y."""
    return np.degrees(Rotation.from_matrix(POSES[device][0]).as_euler("YXZ"))[:, [1, 0, 2]] % 360
