"""Motion logs of watches, phones and inertial sensors, each a table with a sample a row (MocapEvery §4.2).

Read are logs that hold attitude and acceleration: SensorLog's, Sensor Logger's or another app's of Core Motion or
Android, Xsens' MT Manager's texts, Movella DOT's tables, and x-IMU3's files. Columns are known by their names
(`_NAMES`). What the numbers mean is inferred from the values: the unit from the length of gravity, the direction of the
attitude (watch to world or back) from which of the two turns gravity upright, and the sign from whether gravity points
down (Core Motion, whose accelerations have the sign reversed: at rest it reports -1 g along the axis that is up) or up.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.opening import understood
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import slerp
from wearcap.io.formats.csv_table import TableLayout, read_columns, read_layout
from wearcap.io.formats.poses import are_rotations
from wearcap.io.formats.trajectory import UNITS, time_unit_of
from wearcap.recording import ImuStream

G_M_S2 = 9.80665
MIN_RATE_HZ = 20.0
UPRIGHT, UPRIGHT_WHOLE = 0.98, 0.9
"""Least length of the mean of gravity in the world, and its least share along z, of a valid log; and where gravity is
known only with the movement's acceleration, which does not quite cancel."""
_XYZ, _WXYZ = ("x", "y", "z"), ("w", "x", "y", "z")
_NAMES: dict[str, tuple[str, Sequence[Sequence[str]]]] = {
    "turn": ("motionrotationrate rotationrate gyroscope gyro gyr rotation angularvelocity angularrate w", [_XYZ]),
    "gravity": ("motiongravity gravity grav", [_XYZ]),
    "free": ("motionuseracceleration useracceleration useraccel linearacceleration linearaccel linacc", [_XYZ]),
    "whole": ("accelerometeracceleration watchaccelerometer totalacceleration gf", [_XYZ]),
    "either": ("acceleration accelerometer accel acc a", [_XYZ]),
    "world": ("freeacc", [("e", "n", "u"), ("n", "w", "u"), _XYZ]),
    "quaternion": (
        "motionquaternion quaternion quat attitude orientation rotationvector q",
        [_WXYZ, ("q0", "q1", "q2", "q3"), ("0", "1", "2", "3"), ("qw", "qx", "qy", "qz")],
    ),
    "matrix": ("mat", [[f"{row}{column}" for row in "123" for column in "123"]]),
}
"""Names of columns without unit, signs and capitals, but for the axis; then the axes' names. `free` is without gravity, `whole` with it,
`either` one of both, all in the sensor's axes; `world` is without gravity, in the world's."""
_PLAIN = re.compile("watchaccelerometer|totalacceleration|accelerometer|gravity|gyroscope")
"""What columns x, y and z hold, by the file's name."""
_POSITION = re.compile("[tp][xyz](?!.*rate)|pos")
_TIMES = ("sampletimefine", "loggingtime", "time", "epoch", "unix", "secondselapsed", "elapsed", "packetcounter", "t")
_BESIDE = ("Inertial", "Accelerometer", "TotalAcceleration", "Gravity", "Gyroscope", "Orientation", "Quaternion")
"""Files of one sensor in one folder: x-IMU3's and Sensor Logger's of a phone."""
_PERIODS = {"sampletimefine": 2.0**32, "packetcounter": 2.0**16}
RECORD_MOTION = (
    "Record whole motion samples, not single sensors: Wrist Motion (Sensor Logger), Device Motion (SensorLog), "
    "quaternion and free acceleration (MT Manager, Movella DOT), or put the sensor's other files beside."
)


@dataclass(frozen=True)
class WatchConvention:
    """What a watch's numbers mean."""

    m_s2: float
    """Acceleration (m/s²) per unit of its accelerations, negative where their sign is reversed."""
    back: bool
    """Whether its attitude turns the world to the watch, and not the watch to the world."""


_CORE_MOTION, _ANDROID = WatchConvention(-G_M_S2, False), WatchConvention(1.0, False)
_DOCUMENTED = {
    ("motionuseracceleration", "motionquaternion"): _CORE_MOTION,
    ("linearacceleration", "rotationvector"): _ANDROID,
}
"""By the names of free acceleration and attitude, for logs without gravity, which would show it."""


@dataclass(frozen=True)
class WatchLog:
    """A log as it is read."""

    stream: ImuStream
    notes: list[str]
    """What was mended in it, with counts."""


@dataclass(frozen=True)
class _Table:
    """A file's samples in its own units."""

    seconds: np.ndarray
    parts: dict[str, np.ndarray]
    """Values by what they are: the groups of `_NAMES`, with every kind of attitude as `quaternion` (w, x, y, z)."""
    names: dict[str, str]
    """How each of them is named, and `unit` of turn rates, and `xsens` where it is Xsens' or Movella's."""
    notes: list[str]


def read_watch(path: str | Path, joint: str) -> WatchLog:
    """A watch's stream: attitude in a world with z up, free acceleration there (m/s²), specific force, turn rate.

    Timestamps are seconds since 1970, or since the device's start where its clock has no date. The world's heading is
    the watch's own and arbitrary. Rows that are out of order, repeat a time or lack numbers are sorted or left out.
    Raises WearcapError for a joint that is no wrist, a file that is no such log or lacks attitude or acceleration,
    gravity that is neither 1 g nor 9.8 m/s² long, or that neither direction of the attitude turns upright.
    """
    if joint not in WRISTS:
        raise WearcapError(f"a watch on {joint!r}", path, " or ".join(WRISTS))
    log = _read(path, joint)
    if log.stream.acc_world is None:
        lacks = "orientation" if log.stream.R_world_imu is None else "acceleration"
        fix = "Put the sensor's Inertial.csv and Quaternion.csv into one folder."
        raise WearcapError(f"a sensor's log without {lacks}", path, "attitude and acceleration", fix)
    return log


def read_watch_log(path: str | Path, joint: str) -> ImuStream:
    """The stream of `read_watch`, which raises the same."""
    return read_watch(path, joint).stream


def read_inertial_log(path: str | Path, joint: str) -> ImuStream:
    """A log of one sensor at any joint; what x-IMU3's files do not have is None. Raises WearcapError as `read_watch`."""
    return _read(path, joint).stream


def is_watch_log(path: str | Path) -> bool:
    """Whether a table's header is one of these logs', whole or not; raises WearcapError for a file that cannot be opened."""
    try:
        return bool(_groups(read_layout(path), Path(path)))
    except WearcapError:
        if Path(path).is_file():
            return False
        raise


def sensor_files(path: str | Path) -> list[Path]:
    """The files that one sensor's log is made of, this one among them: the first is the one that sets the times."""
    path = Path(path)
    beside = [path.with_name(f"{name}{path.suffix}") for name in _BESIDE]
    return [file for file in beside if file.is_file()] if path in beside else [path]


def watch_convention(
    gravity: np.ndarray, quat_wxyz: np.ndarray, where: str | Path, upright: float = UPRIGHT
) -> WatchConvention:
    """The convention that directions of gravity and attitudes, a row each, show.

    The mean of gravity in the world decides, so that a movement's own acceleration may be part of it.
    Raises WearcapError for gravity that is neither 1 g nor 9.8 m/s² long, attitudes that are no unit quaternions, and
    where neither direction of the attitude turns gravity upright.
    """
    norm = np.linalg.norm(quat_wxyz, axis=1)
    if (np.abs(norm - 1) > 0.01).any():
        row = int(np.argmax(np.abs(norm - 1)))
        raise WearcapError(f"attitude of length {norm[row]:.3g} in row {row}", where, "1")
    # R_world_imu, and the mean of gravity in the world
    R = rotation.matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz)).numpy()
    there, back = (np.einsum("tij,tj->i", turned, gravity) / len(R) for turned in (R, R.swapaxes(1, 2)))
    is_back = bool(abs(there[2]) < abs(back[2]))
    mean = back if is_back else there
    length = float(np.median(np.linalg.norm(gravity, axis=1)))
    unit = next(
        (unit for unit in (G_M_S2, 1.0) for each in (length, abs(mean[2])) if abs(each * unit / G_M_S2 - 1) < 0.1), None
    )  # m/s² per unit
    if unit is None:
        raise WearcapError(f"gravity of length {length:.3g}", where, "1 (g) or 9.8 (m/s²)")
    best = float(abs(mean[2]) / max(np.linalg.norm(mean), min(length, G_M_S2 / unit)))
    if best < upright:
        fix = "Check the order of the quaternion's columns (W, X, Y, Z), and that z is up in its reference frame."
        raise WearcapError(f"the attitude turns gravity {best:.2f} upright", where, f"at least {upright}", fix)
    # Core Motion's gravity points down, and its accelerations have the opposite sign.
    return WatchConvention(float(np.sign(mean[2])) * unit, is_back)


def logging_time(text: str) -> float:
    """Seconds since 1970 of SensorLog's `loggingTime`. Raises ValueError for what is no time."""
    return datetime.fromisoformat(text.strip().replace(" +", "+").replace(" -", "-")).timestamp()


# --- samples to a stream -------------------------------------------------------------------------------------------


def _read(path: str | Path, joint: str) -> WatchLog:
    """The stream of a log's files."""
    tables = [_table(file) for file in sensor_files(path)]
    table = tables[0] if len(tables) == 1 else _joined(tables, path)
    seconds, notes = torch.from_numpy(table.seconds), list(table.notes)
    R, turn, free, felt = None, None, None, None
    if "quaternion" in table.parts:
        R, free, felt = _in_world(table, path)
    elif table.names.get("whole") == "inertial":
        felt = G_M_S2 * torch.from_numpy(table.parts["whole"])
    else:
        raise _lacking(table, path)
    if "turn" in table.parts:
        turn = _turn(table, R, notes)
    R, free, felt, turn = (None if part is None else part.float() for part in (R, free, felt, turn))
    return WatchLog(ImuStream(seconds, joint, R, free, felt, turn), notes)


def _in_world(table: _Table, path: str | Path) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """(R_world_imu, free acceleration in the world, specific force), float64; accelerations where the log has them."""
    quat_wxyz, names = table.parts["quaternion"], table.names
    parts = {name: torch.from_numpy(values) for name, values in table.parts.items()}
    up = torch.tensor([0.0, 0.0, G_M_S2], dtype=torch.float64)
    R = rotation.matrix_from_quat_wxyz(parts["quaternion"])
    world, free, whole, down = (parts.get(name) for name in ("world", "free", "whole", "gravity"))
    if "either" in parts and whole is None and free is None:
        measured = 1.0 if down is None else down.norm(dim=-1).median().item()
        tilt = max((turned @ parts["either"][..., None]).mean(0)[2, 0].abs().item() for turned in (R, R.mT))
        free, whole = (None, parts["either"]) if tilt > measured / 2 else (parts["either"], None)
    if down is None and whole is not None:
        down = whole if free is None else whole - free
    if down is not None:
        sense = watch_convention(down.numpy(), quat_wxyz, path, UPRIGHT_WHOLE if down is whole else UPRIGHT)
    elif world is not None:
        sense = WatchConvention(1.0, False)
    elif free is None:
        return R, None, None
    else:
        sense = _DOCUMENTED.get((names.get("free", ""), names["quaternion"]))
        if sense is None:
            fix = "Log gravity, or the accelerometer, too: they show the unit and the sign of the acceleration."
            raise WearcapError("acceleration without gravity, in an unknown unit", path, "gravity", fix)
    if "xsens" in names and (sense.back or sense.m_s2 < 0):
        fix = "Export it in east, north, up (ENU)."
        raise WearcapError("its attitude is in a world whose z axis points down", path, "z up", fix)
    R = R.mT.contiguous() if sense.back else R
    if whole is not None and free is None:
        felt = sense.m_s2 * whole
        own = (R @ felt[..., None])[..., 0] - up
        if world is not None and (own - world).norm(dim=-1).median() > 0.5:
            raise WearcapError("free acceleration is not the acceleration without gravity", path, "one of the world")
        return R, own if world is None else world, felt
    if world is None and free is not None:
        world = (R @ (sense.m_s2 * free)[..., None])[..., 0]
    if world is None:
        return R, None, None
    felt = (
        sense.m_s2 * (free + down)
        if free is not None and down is not None
        else (R.mT @ (world + up)[..., None])[..., 0]
    )
    return R, world, felt


def _turn(table: _Table, R: Tensor | None, notes: list[str]) -> Tensor | None:
    """Turn rates (rad/s): their unit by its name, else by how the attitude turns; None where neither tells."""
    turn, name = torch.from_numpy(table.parts["turn"]), table.names["turn"]
    unit = table.names.get("unit", "rad/s" if name.endswith("rotationrate") else "")
    if not unit and R is not None:
        step = torch.from_numpy(np.diff(table.seconds))
        turned = rotation.geodesic(R[:-1], R[1:]) / step
        own, moving = (turn[1:] + turn[:-1]).norm(dim=-1) / 2, (turned > 0.2) & (step < 0.1)
        ratio = (own[moving] / turned[moving]).median().item() if moving.sum() > 10 else 0.0
        unit = "rad/s" if 0.5 < ratio < 2 else "deg/s" if 0.5 < np.deg2rad(ratio) < 2 else ""
    if not unit:
        notes.append("turn rates are left out: their unit is not known")
        return None
    return turn.deg2rad() if unit == "deg/s" else turn


def _lacking(table: _Table, path: str | Path) -> WearcapError:
    """The error of a log that is known, but for what it lacks."""
    wanted = {"quaternion": "attitude", "turn": "turn rate"}
    missing = " and ".join(word for name, word in wanted.items() if name not in table.parts)
    has = ", ".join(
        sorted(
            {"either": "acceleration", "whole": "acceleration", "free": "acceleration", "turn": "turn rate"}.get(
                part, part
            )
            for part in table.parts
        )
    )
    return WearcapError(f"a motion log with {has}, without {missing}", path, "attitude and acceleration", RECORD_MOTION)


# --- tables to samples ---------------------------------------------------------------------------------------------


def _groups(layout: TableLayout, path: Path) -> dict[str, tuple[str, list[str]]]:
    """Groups of columns by what they are: (how they are named, columns); none for another kind of table."""
    keys = {_key(column): column for column in reversed(layout.header)}
    if any(_POSITION.match(key) for key in keys):
        return {}
    if {*_XYZ} <= set(keys) and (plain := _PLAIN.search(_key(path.stem))):
        keys |= {plain.group() + axis: keys[axis] for axis in _XYZ}
    if {*_WXYZ} == set(keys) - {*_TIMES, "timestamp"}:
        keys |= {"quaternion" + axis: keys[axis] for axis in _WXYZ}
    found = {}
    for part, (names, axes) in _NAMES.items():
        known = ((name, [name + each for each in axis]) for name in names.split() for axis in axes)
        for name, columns in known:
            if part not in found and set(columns) <= set(keys):
                found[part] = name, [keys[column] for column in columns]
    quaternions = found.get("quaternion", ("", []))[0]
    alone = quaternions.endswith("quaternion") or path.stem in _BESIDE
    return found if set(found) - {"quaternion", "matrix"} or (found and alone) else {}


def _key(column: str) -> str:
    """A column's name without unit, signs and capitals."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"[(\[][^)\]]*[^\d)\]][^)\]]*[)\]]", "", column.lower()))


def _table(path: Path) -> _Table:
    """Samples of one file in the order of time. Raises WearcapError as `read_watch` does."""
    layout = read_layout(path)
    groups = _groups(layout, path)
    if not groups:
        expected = "attitude and acceleration of a watch or sensor (motionQuaternionW(R), quaternionW, Quat_q0, …)"
        raise WearcapError("not a watch's motion log", path, expected, RECORD_MOTION)
    keys = {_key(column): column for column in reversed(layout.header)}
    names = {part: name for part, (name, _) in groups.items()}
    if "packetcounter" in keys:
        names["xsens"] = "packetcounter"
    if "turn" in groups and (unit := re.search(r"rad|deg|dps|°", groups["turn"][1][0].lower())):
        names["unit"] = "rad/s" if unit.group() == "rad" else "deg/s"
        if unit.group() == "deg" and names.get("either") == "accelerometer":  # x-IMU3's, whose conventions are known
            groups["whole"], names["whole"] = groups.pop("either"), "inertial"
    table = read_columns(path, list(dict.fromkeys(name for _, group in groups.values() for name in group)))
    parts = {part: np.stack([table[column] for column in group], 1) for part, (_, group) in groups.items()}
    if (matrix := parts.pop("matrix", None)) is not None and "quaternion" not in parts:
        R = torch.from_numpy(matrix).reshape(-1, 3, 3)
        if not are_rotations(R[R.isfinite().all(-1).all(-1)], 0.02).all():
            raise WearcapError("matrices that are no rotations", path, "orthogonal matrices")
        parts["quaternion"], names["quaternion"] = rotation.quat_wxyz_from_matrix(R).numpy(), "matrix"
    seconds, parts, notes = _in_order(_seconds(path, layout, keys), parts, path)
    return _Table(seconds, parts, names, notes)


def _seconds(path: Path, layout: TableLayout, keys: dict[str, str]) -> np.ndarray:
    """Times of the rows (s), not a number where a row has none."""
    rate = re.search(r"(?:update|output) ?rate\W*([\d.]+)", " ".join(layout.about).lower())
    for key in [key for name in _TIMES for key in keys if key == name or (key.startswith(name) and len(name) > 3)]:
        texts = read_columns(path, [], text=[keys[key]])[keys[key]]
        if np.isin(np.char.lower(texts), (b"nan", b"")).all() or (key == "packetcounter" and rate is None):
            continue
        try:
            times = texts.astype(np.float64)
        except ValueError:
            return _dates(texts, path)
        known = np.isfinite(times)
        if key in _PERIODS:
            times[known] = np.unwrap(times[known], period=_PERIODS[key])
        if key == "packetcounter" and rate is not None:
            return times / float(rate[1])
        if key == "sampletimefine":  # µs of Movella DOT, else ticks of 0.1 ms
            return times * (1e-6 if np.median(np.abs(np.diff(times[known]))) >= 1000 else 1e-4)
        unit = re.search(r"(?:\b|_)([mun]?s)\b", keys[key].lower().replace("µ", "u"))
        return times * UNITS[time_unit_of(times[known], unit and unit[1], path)]
    fix = "Export SampleTimeFine, or the update rate above the table." if "packetcounter" in keys else ""
    raise WearcapError("no times", path, "a column such as time, timestamp or SampleTimeFine", fix)


def _dates(texts: np.ndarray, path: Path) -> np.ndarray:
    times = np.empty(len(texts))
    for row, text in enumerate(texts):
        with understood(f"time {text.decode()!r} in row {row}", path, "such as 2024-05-01T12:00:00.123+02:00"):
            times[row] = logging_time(text.decode())
    return times


def _in_order(
    seconds: np.ndarray, parts: dict[str, np.ndarray], path: Path
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Rows in the order of time, one for each time, and what was done for it.

    Raises WearcapError for fewer than 2 rows or 20 a second, and for a clock that starts again.
    """
    values = np.concatenate([seconds[:, None], *parts.values()], 1)
    whole = np.isfinite(values).all(1)
    values = values[whole]
    late = values[:, 0] < np.maximum.accumulate(values[:, 0])
    back = (np.maximum.accumulate(values[:, 0]) - values[:, 0]).max(initial=0.0)
    order = np.argsort(values[:, 0], kind="stable")
    values, moved = values[order], late[order]
    first = np.diff(values[:, 0], prepend=-np.inf) > 0
    same = np.append(False, (values[1:] == values[:-1]).all(1))
    if back > 1.0 and np.count_nonzero(np.diff(moved[~same])) > 0.05 * len(values):
        what = f"the clock goes back by {back:.1f} s, over times that other rows have"
        raise WearcapError(what, path, "one recording", "Two recordings stand in one file: cut it there.")
    notes = [
        f"{count} row{'s' * (count > 1)} {what}"
        for count, what in (
            (int((~whole).sum()), "without all numbers left out"),
            (int(late.sum()), "out of order sorted"),
            (int((~first & same).sum()), "repeated, left out"),
            (int((~first & ~same).sum()), "at a time of another row, with other values, left out"),
        )
        if count
    ]
    values = values[first]
    if len(values) < 2:
        raise WearcapError(f"{len(values)} rows with numbers and a time of their own", path, "at least 2")
    step = np.median(np.diff(values[:, 0]))
    if step > 1 / MIN_RATE_HZ:
        raise WearcapError(f"{1 / step:.1f} rows a second", path, f"at least {MIN_RATE_HZ:g}", "Log at 30 Hz or more.")
    ends = np.cumsum([1, *(part.shape[1] for part in parts.values())])
    split = {name: values[:, a:b] for name, a, b in zip(parts, ends[:-1], ends[1:])}
    return np.ascontiguousarray(values[:, 0]), split, notes


def _joined(tables: list[_Table], path: str | Path) -> _Table:
    """One sensor's files at the times of the first of them, where all of them have samples."""
    begin, end = max(table.seconds[0] for table in tables), min(table.seconds[-1] for table in tables)
    seconds = tables[0].seconds
    seconds = seconds[(seconds >= begin - 0.05) & (seconds <= end + 0.05)]
    if len(seconds) < 2:
        raise WearcapError("files of one sensor without common times", path, "files of one recording")
    parts, names, notes = dict[str, np.ndarray](), dict[str, str](), list[str]()
    for table in reversed(tables):
        for part, values in table.parts.items():
            if part == "quaternion":
                R = rotation.matrix_from_quat_wxyz(torch.from_numpy(values))
                R = slerp(torch.from_numpy(table.seconds), R, torch.from_numpy(seconds))
                parts[part] = rotation.quat_wxyz_from_matrix(R).numpy()
            else:
                parts[part] = np.stack([np.interp(seconds, table.seconds, each) for each in values.T], 1)
        names |= table.names
        notes += table.notes
    return _Table(seconds, parts, names, notes)
