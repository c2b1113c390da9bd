"""Motion logs of a watch: SensorLog's CSV, and Sensor Logger's or Apple Watch's WristMotion.csv (MocapEvery §4.2); and
x-IMU3's Inertial.csv (degrees a second, g) with Quaternion.csv beside.

The watches' hold Core Motion's output: attitude, turn rate, the direction of gravity and the acceleration without it. The
conventions of a file are inferred from its values: the unit from the length of gravity, the direction of the attitude
(watch to world or back) from which of the two turns gravity upright, and the sign from whether gravity points down
(Core Motion, whose accelerations have the sign reversed: at rest it reports -1 g along the axis that is up) or up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import torch

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.opening import understood
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.geometry.trajectory import slerp
from wearcap.io.formats.csv_table import read_columns, read_header
from wearcap.io.formats.poses import check_finite
from wearcap.recording import ImuStream

G_M_S2 = 9.80665
MIN_RATE_HZ = 20.0
UPRIGHT = 0.98
"""Least length of the mean direction of gravity in the world, and its least share along z, of a valid log."""
_XYZ = ("X", "Y", "Z")
_SENSOR_LOGGER = {
    "turn": [f"rotationRate{axis}" for axis in _XYZ],
    "gravity": [f"gravity{axis}" for axis in _XYZ],
    "free": [f"acceleration{axis}" for axis in _XYZ],
    "quaternion": [f"quaternion{axis}" for axis in "WXYZ"],
}
_SENSOR_LOG = {
    "turn": [f"motionRotationRate{axis}(rad/s)" for axis in _XYZ],
    "whole": [f"accelerometerAcceleration{axis}(G)" for axis in _XYZ],
    "free": [f"motionUserAcceleration{axis}(G)" for axis in _XYZ],
    "quaternion": [f"motionQuaternion{axis}(R)" for axis in "WXYZ"],
}

_X_IMU = [f"{name} {axis} ({unit})" for name, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g")) for axis in _XYZ]
_X_QUATERNION = {"W", "X", "Y", "Z"}


@dataclass(frozen=True)
class WatchConvention:
    """What a watch's numbers mean."""

    m_s2: float
    """Acceleration (m/s²) per unit of its accelerations, negative where their sign is reversed."""
    back: bool
    """Whether its attitude turns the world to the watch, and not the watch to the world."""


def read_watch_log(path: str | Path, joint: str) -> ImuStream:
    """A watch's stream: attitude in a world with z up, free acceleration there (m/s²), specific force, turn rate.

    Timestamps are seconds since 1970. The world's heading is the watch's own and arbitrary.
    Raises WearcapError for a joint that is no wrist, a file that is neither format, times that do not grow, values that
    are not finite, gravity that is neither 1 g nor 9.8 m/s² long, or that neither direction of the attitude turns upright.
    """
    if joint not in WRISTS:
        raise WearcapError(f"a watch on {joint!r}", path, " or ".join(WRISTS))
    header = set(read_header(path))
    if set(_X_IMU) & header or header >= _X_QUATERNION:
        stream = read_inertial_log(path, joint)
        if stream.acc_world is None:
            fix = "Put the sensor's Quaternion.csv beside its Inertial.csv."
            raise WearcapError("a sensor's log without orientation", path, "attitude and acceleration", fix)
        return stream
    seconds, parts = _columns(path)
    _require_times(seconds, path)
    for name, values in parts.items():
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(1))[0])
            raise WearcapError(f"{name} of row {row} is not finite", path, "numbers")
    gravity = parts["gravity"] if "gravity" in parts else parts["whole"] - parts["free"]
    sense = watch_convention(gravity, parts["quaternion"], path)
    R = matrix_from_quat_wxyz(torch.from_numpy(parts["quaternion"])).numpy()
    if sense.back:
        R = np.ascontiguousarray(R.swapaxes(1, 2))
    free, felt = sense.m_s2 * parts["free"], sense.m_s2 * (parts["free"] + gravity)
    turn = torch.from_numpy(parts["turn"]).float() if "turn" in parts else None
    return ImuStream(
        torch.from_numpy(seconds),
        joint,
        torch.from_numpy(R).float(),
        acc_world=torch.from_numpy(np.einsum("tij,tj->ti", R, free)).float(),
        acc_imu=torch.from_numpy(felt).float(),
        gyro_imu=turn,
    )


def watch_convention(gravity: np.ndarray, quat_wxyz: np.ndarray, where: str | Path) -> WatchConvention:
    """The convention that directions of gravity and attitudes, a row each, show.

    Raises WearcapError for gravity that is neither 1 g nor 9.8 m/s² long, attitudes that are no unit quaternions, and
    where neither direction of the attitude turns gravity upright.
    """
    length = float(np.median(np.linalg.norm(gravity, axis=1)))
    unit = next((unit for unit in (G_M_S2, 1.0) if abs(length * unit / G_M_S2 - 1) < 0.1), None)  # m/s² per unit
    if unit is None:
        raise WearcapError(f"gravity of length {length:.3g}", where, "1 (g) or 9.8 (m/s²)")
    norm = np.linalg.norm(quat_wxyz, axis=1)
    if (np.abs(norm - 1) > 0.01).any():
        row = int(np.argmax(np.abs(norm - 1)))
        raise WearcapError(f"attitude of length {norm[row]:.3g} in row {row}", where, "1")
    # R_world_imu, and the component of gravity along the world's z: about 1 or -1
    R = matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz)).numpy()
    down = gravity / np.linalg.norm(gravity, axis=1, keepdims=True).clip(1e-9)
    there, back = (float((turned @ down[..., None])[:, 2, 0].mean()) for turned in (R, R.swapaxes(1, 2)))
    best = max(abs(there), abs(back))
    if best < UPRIGHT:
        fix = "Check the order of the quaternion's columns (W, X, Y, Z), and that z is up in its reference frame."
        raise WearcapError(f"the attitude turns gravity {best:.2f} upright", where, f"at least {UPRIGHT}", fix)
    is_back = abs(there) < abs(back)
    # Core Motion's gravity points down, and its accelerations have the opposite sign.
    return WatchConvention(float(np.sign(back if is_back else there)) * unit, is_back)


def is_watch_log(path: str | Path) -> bool:
    """Whether a CSV has the header of one of these logs; raises WearcapError for a file that cannot be opened."""
    try:
        header = set(read_header(path))
    except WearcapError:
        if Path(path).is_file():
            return False
        raise
    return bool(header & {"quaternionW", "motionQuaternionW(R)", _X_IMU[-1]} or header >= _X_QUATERNION)


def read_inertial_log(path: str | Path, joint: str) -> ImuStream:
    """x-IMU3's log of one sensor: Inertial.csv, Quaternion.csv, or each with the other beside; times count from its start.

    What no file has is None; free acceleration needs both. Raises WearcapError as `read_watch_log` does.
    """
    path = Path(path)
    header = set(read_header(path))
    inertial = path if _X_IMU[-1] in header else path.with_name("Inertial.csv")
    quaternion = path if header >= _X_QUATERNION else path.with_name("Quaternion.csv")
    seconds, R, turn, felt = None, None, None, None
    if inertial.is_file():
        seconds, table = _x_table(inertial, _X_IMU)
        turn, felt = torch.from_numpy(np.deg2rad(table[:, :3])).float(), torch.from_numpy(G_M_S2 * table[:, 3:])
    if quaternion.is_file():
        times, table = _x_table(quaternion, ("W", "X", "Y", "Z"))
        norm = np.linalg.norm(table, axis=1)
        if (np.abs(norm - 1) > 0.01).any():
            row = int(np.argmax(np.abs(norm - 1)))
            raise WearcapError(f"attitude of length {norm[row]:.3g} in row {row}", quaternion, "1")
        R = matrix_from_quat_wxyz(torch.from_numpy(table))
        if seconds is not None:
            times = torch.from_numpy(times)
            at = torch.from_numpy(seconds).clamp(times[0].item(), times[-1].item())
            R = slerp(times, R, at)
        else:
            seconds = times
    assert seconds is not None, "one of the two is the given file"
    free = None
    if R is not None and felt is not None:
        free = (R @ felt[..., None])[..., 0] - torch.tensor([0.0, 0.0, G_M_S2])
        upright = (torch.nn.functional.normalize(felt, dim=-1)[..., None] * R.mT[:, :, 2:]).sum((1, 2)).mean().item()
        if upright < 0.8:
            fix = "The attitude turns the sensor into a world with z up; take both files of one recording."
            raise WearcapError(f"gravity is {upright:.2f} upright by the attitude", path, "0.8 or more", fix)
    parts = [None if part is None else part.float() for part in (R, free, felt)]
    return ImuStream(torch.from_numpy(seconds), joint, parts[0], parts[1], parts[2], turn)


def _x_table(path: Path, columns: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and columns of a file of x-IMU3."""
    time = next((name for name in read_header(path) if name.startswith(("Time (", "Timestamp ("))), "Timestamp (us)")
    table = read_columns(path, [time, *columns])
    values = np.stack([table[name] for name in columns], 1)
    check_finite({"time": table[time], "values": values}, path)
    seconds = table[time] * (1e-6 if "(us)" in time else 1.0)
    _require_times(seconds, path)
    return seconds, values


def _columns(path: str | Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Time in seconds, and groups of columns."""
    header = read_header(path)
    if "quaternionW" in header:
        groups, time = _SENSOR_LOGGER, "time"
        table = read_columns(path, [name for group in groups.values() for name in group], whole=[time])
        seconds = table[time] / 1e9
    elif "motionQuaternionW(R)" in header:
        # The wearer chooses which of Core Motion's other outputs are logged.
        groups = {name: group for name, group in _SENSOR_LOG.items() if name != "turn" or set(group) <= set(header)}
        time = "loggingTime(txt)"
        table = read_columns(path, [name for group in groups.values() for name in group], text=[time])
        seconds = np.empty(len(table[time]))
        for row, text in enumerate(table[time]):
            with understood(f"time {text.decode()!r} in row {row}", path, "such as 2024-05-01T12:00:00.123+02:00"):
                seconds[row] = logging_time(text.decode())
    else:
        expected = "SensorLog's CSV (motionQuaternionW(R), …) or WristMotion.csv (quaternionW, …)"
        raise WearcapError("not a watch's motion log", path, expected, "Switch on device motion when you record.")
    return seconds, {name: np.stack([table[column] for column in group], 1) for name, group in groups.items()}


def logging_time(text: str) -> float:
    """Seconds since 1970 of SensorLog's `loggingTime`. Raises ValueError for what is no time."""
    return datetime.fromisoformat(text.strip().replace(" +", "+").replace(" -", "-")).timestamp()


def _require_times(seconds: np.ndarray, path: str | Path) -> None:
    if len(seconds) < 2:
        raise WearcapError(f"{len(seconds)} rows", path, "at least 2")
    step = np.diff(seconds)
    if (step <= 0).any():
        row = int(np.flatnonzero(step <= 0)[0]) + 1
        what = f"time does not grow at line {row + 2} ({step[row - 1]:+.3f} s)"
        raise WearcapError(what, path, fix="Sort the rows by time and leave repeated ones out.")
    if np.median(step) > 1 / MIN_RATE_HZ:
        what = f"{1 / np.median(step):.1f} rows a second"
        raise WearcapError(what, path, f"at least {MIN_RATE_HZ:g}", "Log at 30 Hz or more.")
