"""Motion logs of watches, phones and inertial sensors, each a table with a sample a row (MocapEvery §4.2).

Read are logs that hold attitude and acceleration: SensorLog's, Sensor Logger's or another app's of Core Motion or
Android, Xsens' MT Manager's texts, Movella DOT's tables, and x-IMU3's files. Columns are known by their names
(`_NAMES`). What the numbers mean is inferred from the values: the unit from the length of gravity, the direction of the
attitude (watch to world or back) from which of the two turns gravity upright, and the sign from whether gravity points
down (Core Motion, whose accelerations have the sign reversed: at rest it reports -1 g along the axis that is up) or up.
"""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.opening import understood
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.geometry.trajectory import slerp
from wearcap.io.formats.csv_table import read_columns, read_layout
from wearcap.io.formats.poses import are_rotations
from wearcap.io.formats.times import UNITS, in_order, time_unit_of, unit_named, without_repeats
from wearcap.recording import ImuStream

G_M_S2 = 9.80665
MIN_RATE_HZ = 20.0
UPRIGHT, UPRIGHT_WHOLE = 0.98, 0.9
"""Least length of the mean of gravity in the world, and its least share along z, of a valid log; and where gravity is
known only with the movement's acceleration, which does not quite cancel."""
_XYZ, _WXYZ = ("x", "y", "z"), ("w", "x", "y", "z")
_NAMES: dict[str, tuple[str, Sequence[Sequence[str]]]] = {
    "turn": ("motionrotationrate rotationrate gyroscope gyro gyr rotation angularvelocity w", [_XYZ]),
    "gravity": ("motiongravity gravity", [_XYZ]),
    "free": ("motionuseracceleration useracceleration linearacceleration linearaccel linacc", [_XYZ]),
    "whole": ("accelerometeracceleration watchaccelerometer totalacceleration gf", [_XYZ]),
    "either": ("acceleration accelerometer accel acc a", [_XYZ]),
    "world": ("freeacc", [("e", "n", "u"), ("n", "w", "u"), _XYZ]),
    "quaternion": (
        "motionquaternion quaternion quat attitude orientation rotationvector q",
        [_WXYZ, ("q0", "q1", "q2", "q3"), ("0", "1", "2", "3"), ("qw", "qx", "qy", "qz")],
    ),
    "vector": ("rotationvector", [_XYZ]),
    "matrix": ("mat", [[f"{row}{column}" for row in "123" for column in "123"]]),
}
"""Columns' names without unit, signs and capitals, but for the axis, and the axes'. In the sensor's axes `free` is without
gravity, `whole` with it, `either` one of both; `world` is without, in the world's."""
_PLAIN = re.compile("(watchaccelerometer|totalacceleration|accelerometer|gravity|gyroscope)(?!uncal)")
"""What columns x, y and z hold, by the file's name."""
_POSITION = re.compile("^[tp][xyz]|pos(ition)?[xyz]|hmd")
_TIMES = re.compile(
    "(sampletimefine)|(loggingtime)|(motiontimestamp)|(time|epoch|unix|t$)|(secondselapsed)|(packetcounter)"
)
"""Beginnings of the names of times, the best first."""
_BESIDE = ("Inertial", "Accelerometer", "TotalAcceleration", "Gravity", "Gyroscope", "Orientation", "Quaternion")
"""Files of one sensor in one folder: x-IMU3's and Sensor Logger's of a phone."""
_ACCELERATION, _X_IMU = {"free", "whole", "either", "world"}, "inertial"
_PERIODS = {"sampletimefine": 2.0**32, "packetcounter": 2.0**16}
_RECORD_MOTION = (
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


_DOCUMENTED = {
    ("motionuseracceleration", "motionquaternion"): WatchConvention(-G_M_S2, False),  # Core Motion
    ("linearacceleration", "rotationvector"): WatchConvention(1.0, False),  # Android
}
"""By the names of free acceleration and attitude, for logs without gravity, which would show it."""


class WatchLog(NamedTuple):
    """A log as it is read, and what was mended in it, with counts."""

    stream: ImuStream
    notes: list[str]


class _Samples(NamedTuple):
    """Rows in the order of time (s), by the groups of `_NAMES` (every attitude as `quaternion`), in their own units."""

    seconds: np.ndarray
    parts: dict[str, np.ndarray]
    names: dict[str, str]
    """How each group is named; `unit` is the turn rate's, `xsens` there for Xsens and Movella."""
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
    samples = _samples(path)
    if "quaternion" not in samples.parts or not samples.parts.keys() & _ACCELERATION:
        raise _lacking(samples, path)
    return _stream(samples, joint, path)


def read_watch_log(path: str | Path, joint: str) -> ImuStream:
    """The stream of `read_watch`, which raises the same."""
    return read_watch(path, joint).stream


def read_inertial_log(path: str | Path, joint: str) -> ImuStream:
    """A log of one sensor at any joint; what x-IMU3's files do not have is None. Raises WearcapError as `read_watch`."""
    return _stream(_samples(path), joint, path).stream


def is_watch_log(path: str | Path) -> bool:
    """Whether a table's header is one of these logs', whole or not; raises WearcapError for a file that cannot be opened."""
    try:
        return bool(_groups(read_layout(path)[1], Path(path)))
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
    R = matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz)).numpy()
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


def _stream(samples: _Samples, joint: str, path: str | Path) -> WatchLog:
    """A sensor's stream; parts that it lacks are None. Raises WearcapError where no attitude shows what its numbers mean."""
    R, free, felt, turn, notes = None, None, None, None, [*samples.notes]
    if "quaternion" in samples.parts:
        R, free, felt = _in_world(samples, path)
    elif samples.names.get("whole") == _X_IMU:
        felt = G_M_S2 * torch.from_numpy(samples.parts["whole"])
    else:
        raise _lacking(samples, path)
    if "turn" in samples.parts:
        turn = _turn(samples, R, notes)
    parts = [None if part is None else part.float() for part in (R, free, felt, turn)]
    return WatchLog(ImuStream(torch.from_numpy(samples.seconds), joint, *parts), notes)


def _in_world(samples: _Samples, path: str | Path) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """(R_world_imu, free acceleration in the world, specific force), float64; accelerations where the log has them."""
    parts = {name: torch.from_numpy(values) for name, values in samples.parts.items()}
    R, up = matrix_from_quat_wxyz(parts["quaternion"]), torch.tensor([0.0, 0.0, G_M_S2], dtype=torch.float64)
    world, free, whole, down = (parts.get(name) for name in ("world", "free", "whole", "gravity"))
    if "either" in parts and whole is None:
        measured = 1.0 if down is None else down.norm(dim=-1).median()
        upright = max((turned @ parts["either"][..., None]).mean(0)[2, 0].abs() for turned in (R, R.mT))
        whole = parts["either"] if upright > measured / 2 else None
        free = parts["either"] if whole is None and free is None else free
    if whole is not None and (free is None or down is None):
        down = whole if free is None else whole - free
    if free is None and whole is None and world is None:
        return R, None, None
    if down is not None:
        least = UPRIGHT_WHOLE if down is whole else UPRIGHT
        sense = watch_convention(down.numpy(), samples.parts["quaternion"], path, least)
    elif world is not None:
        sense = WatchConvention(1.0, False)
    elif (sense := _DOCUMENTED.get((samples.names.get("free", ""), samples.names["quaternion"]))) is None:
        fix = "Log gravity (Gravity.csv) or the whole acceleration, too: it shows unit and sign."
        raise WearcapError("acceleration without gravity, whose unit and sign are not known", path, "gravity", fix)
    if "xsens" in samples.names and (sense.m_s2 < 0 or samples.names["xsens"] == "ned"):
        raise WearcapError("its world's z axis points down", path, "z up", "Export in east, north, up (ENU).")
    R = R.mT.contiguous() if sense.back else R
    felt = None if down is None else sense.m_s2 * (down if free is None else free + down)
    if world is None:
        assert felt is not None or free is not None
        world = _turned(R, felt) - up if free is None else _turned(R, sense.m_s2 * free)
    elif felt is not None and (_turned(R, felt) - up - world).norm(dim=-1).median() > 0.5:
        raise WearcapError("free acceleration is not acceleration without gravity", path, "FreeAcc in the world's axes")
    return R, world, _turned(R.mT, world + up) if felt is None else felt


def _turned(R: Float[Tensor, "time 3 3"], vector: Float[Tensor, "time 3"]) -> Float[Tensor, "time 3"]:
    return (R @ vector[..., None])[..., 0]


def _turn(samples: _Samples, R: Tensor | None, notes: list[str]) -> Tensor | None:
    """Turn rates (rad/s): their unit by its name, else by how the attitude turns; None where neither says it."""
    turn, name = torch.from_numpy(samples.parts["turn"]), samples.names["turn"]
    unit = samples.names.get("unit", "rad" if name.endswith("rotationrate") else "")
    if not unit and R is not None:
        step = torch.from_numpy(np.diff(samples.seconds))
        turned, own = rotation.geodesic(R[:-1], R[1:]) / step, (turn[1:] + turn[:-1]).norm(dim=-1) / 2
        moving = (turned > 0.2) & (step < 0.1)
        ratio = (own / turned)[moving].median().item() if moving.any() else 0.0
        unit = "rad" if 0.5 < ratio < 2 else "deg" if 0.5 < np.deg2rad(ratio) < 2 else ""
    if not unit:
        notes.append("turn rates left out: their unit is not known")
        return None
    return turn.deg2rad() if unit == "deg" else turn


def _lacking(samples: _Samples, path: str | Path) -> WearcapError:
    """The error of a log that is known, but for what it lacks."""
    wanted = {"attitude": {"quaternion"}, "acceleration": _ACCELERATION, "turn rate": {"turn"}}
    missing = [word for word, parts in wanted.items() if not parts & samples.parts.keys()]
    what = f"a motion log without {' and '.join(missing)}"
    return WearcapError(what, path, "attitude and acceleration", _RECORD_MOTION)


# --- tables to samples ---------------------------------------------------------------------------------------------


def _groups(header: list[str], path: Path) -> dict[str, tuple[str, list[str]]]:
    """Groups of columns by what they are: (how they are named, columns); none for another kind of table."""
    keys = {_key(column): column for column in reversed(header)}
    if any(_POSITION.search(key) for key in keys):
        return {}
    if {*_WXYZ} == {key for key in keys if not _TIMES.match(key)}:
        keys |= {"quaternion" + axis: keys[axis] for axis in _WXYZ}
    elif {*_XYZ} <= set(keys):
        if (plain := _PLAIN.search(_key(path.stem))) is None:
            return {}
        keys |= {plain[1] + axis: keys[axis] for axis in _XYZ}
    found = dict[str, tuple[str, list[str]]]()
    for part, (names, axes) in _NAMES.items():
        for name, axis in itertools.product(names.split(), axes):
            if part not in found and {name + each for each in axis} <= set(keys):
                found[part] = name, [keys[name + each] for each in axis]
    alone = path.stem in _BESIDE or found.get("quaternion", ("",))[0].endswith("quaternion")
    sure = {name for name, _ in found.values()} - {"a", "w"}  # of letters alone only beside others
    return found if alone or (sure and found.keys() - {"quaternion", "matrix", "vector"}) else {}


def _key(column: str) -> str:
    """A column's name without unit, signs and capitals."""
    unit = r"[(\[][^)\]]*[^\d)\]][^)\]]*[)\]]|_(g|m_?p?_?s2|rad_?p?_?s|deg_?p?_?s|dps)$"
    return re.sub(r"[^a-z0-9]", "", re.sub(unit, "", column.lower()))


def _samples(path: str | Path) -> _Samples:
    """Samples of a log's files, at the times of the first of them where all have some."""
    tables = [_table(file) for file in sensor_files(path)]
    if len(tables) == 1:
        return tables[0]
    begin, end = max(table.seconds[0] for table in tables), min(table.seconds[-1] for table in tables)
    seconds = tables[0].seconds
    seconds = seconds[(seconds >= begin - 0.05) & (seconds <= end + 0.05)]
    if len(seconds) < 2:
        raise WearcapError("its sensors' files share no times", path, "files of one recording")
    joined = _Samples(seconds, {}, {}, [note for table in tables for note in table.notes])
    for table in reversed(tables):
        for part, values in table.parts.items():
            joined.parts[part] = np.stack([np.interp(seconds, table.seconds, each) for each in values.T], 1)
        if "quaternion" in table.parts:
            R = matrix_from_quat_wxyz(torch.from_numpy(table.parts["quaternion"]))
            R = slerp(torch.from_numpy(table.seconds), R, torch.from_numpy(seconds))
            joined.parts["quaternion"] = quat_wxyz_from_matrix(R).numpy()
        joined.names.update(table.names)
    return joined


def _table(path: Path) -> _Samples:
    """Samples of one file."""
    above, header, _ = read_layout(path)
    about, groups = " ".join(above).lower(), _groups(header, path)
    if not groups:
        expected = "attitude and acceleration of a watch or sensor (motionQuaternionW(R), quaternionW, Quat_q0, …)"
        raise WearcapError("not a watch's motion log", path, expected, _RECORD_MOTION)
    names = {part: name for part, (name, _) in groups.items()}
    if "PacketCounter" in header:
        names["xsens"] = "ned" if "system: ned" in about else "up"
    if "turn" in groups and (unit := re.search("rad|deg|dps|°", groups["turn"][1][0].lower())):
        names["unit"] = "rad" if unit[0] == "rad" else "deg"
        if unit[0] == "deg" and names.get("either") == "accelerometer":
            groups["whole"], names["whole"] = groups.pop("either"), _X_IMU
    table = read_columns(path, list(dict.fromkeys(name for _, group in groups.values() for name in group)))
    parts = {part: np.stack([table[column] for column in group], 1) for part, (_, group) in groups.items()}
    parts = {part: values for part, values in parts.items() if np.isfinite(values).any()}
    if (matrix := parts.pop("matrix", None)) is not None and "quaternion" not in parts:
        R = torch.from_numpy(matrix).reshape(-1, 3, 3)
        if not are_rotations(R[R.isfinite().all(-1).all(-1)], 0.02).all():
            raise WearcapError("matrices that are no rotations", path, "orthogonal matrices")
        parts["quaternion"], names["quaternion"] = quat_wxyz_from_matrix(R).numpy(), "matrix"
    if (vector := parts.pop("vector", None)) is not None and "quaternion" not in parts:  # Android's, with w at least 0
        w = np.sqrt((1 - (vector**2).sum(1)).clip(0))
        parts["quaternion"], names["quaternion"] = np.column_stack([w, vector]), "rotationvector"
    if "quaternion" in parts:  # zeros where the attitude was lost
        parts["quaternion"][(parts["quaternion"] == 0).all(1)] = np.nan
    return _in_order(_seconds(path, header, about), parts, names, path)


def _seconds(path: Path, header: list[str], about: str) -> np.ndarray:
    """Times of the rows (s), not a number where a row has none."""
    rate = re.search(r"(?:update|output) ?rate\W*([\d.]+)", about)
    named = [(match.lastindex or 0, column) for column in header if (match := _TIMES.match(_key(column)))]
    for _, column in sorted(named, key=lambda each: each[0]):
        key, texts = _key(column), read_columns(path, [], text=[column])[column]
        try:
            times = texts.astype(np.float64)
        except ValueError:
            with understood("times that cannot be read", path, "numbers, or such as 2024-05-01T12:00:00.123+02:00"):
                return np.array([logging_time(text.decode()) for text in texts])
        known = np.isfinite(times)
        if not known.any() or (key == "packetcounter" and rate is None):
            continue
        if key in _PERIODS:
            times[known] = np.unwrap(times[known], period=_PERIODS[key])
        if key == "packetcounter" and rate is not None:
            return times / float(rate[1])
        if key == "sampletimefine":  # µs of Movella DOT, else ticks of 0.1 ms
            return times * (1e-6 if np.median(np.abs(np.diff(times[known]))) >= 1000 else 1e-4)
        return times * UNITS[time_unit_of(times[known], unit_named(column), path)]
    raise WearcapError("no times", path, "time, timestamp, SampleTimeFine, or PacketCounter with the update rate above")


def _in_order(seconds: np.ndarray, parts: dict[str, np.ndarray], names: dict[str, str], path: Path) -> _Samples:
    """Rows in the order of time, one for each time, with notes of what was done for it.

    Raises WearcapError for fewer than 2 rows or 20 a second, and for two recordings in one file.
    """
    values = np.concatenate([np.zeros((len(seconds), 0)), *parts.values()], 1)  # all may have been without numbers
    # An attitude is smooth but for its sign; other numbers may jump from row to row.
    smooth = np.abs(parts["quaternion"]) if "quaternion" in parts else values
    whole = np.isfinite(values).all(1)
    order, notes = in_order(seconds, smooth, whole, "a number in every column", path)
    kept, repeated = without_repeats(seconds, values, order)
    seconds = seconds[kept]
    if len(seconds) < 2:
        raise WearcapError(f"{len(seconds)} rows with numbers and a time of their own", path, "at least 2")
    rate = 1 / np.median(np.diff(seconds))
    if rate < MIN_RATE_HZ:
        raise WearcapError(f"{rate:.1f} rows a second", path, f"at least {MIN_RATE_HZ:g}", "Log at 30 Hz or more.")
    return _Samples(seconds, {name: values[kept] for name, values in parts.items()}, names, notes + repeated)
