"""Logs of headsets (OpenXR applications, Unity, SteamVR): poses of the head and of two hands or controllers, as CSV or JSON.

Names of columns are taken apart ("head_pos_x", "headPosX", "HMD.position.x", "LeftController Rotation W"): a device (head,
left or right), a quantity (position, quaternion, matrix) and a component. JSON is an object or a list of frames, or one
object a line; nested keys become such names, and arrays of 3, 4, 12 or 16 numbers their components. Rows in which a hand
is not tracked (empty, null, or all zero) are left out of its path.
"""

import csv
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.limits import LIMITS
from wearcap.boundary.opening import open_bytes, understood
from wearcap.boundary.texts import numbered_lines, parse_json, read_json
from wearcap.errors import WearcapError
from wearcap.io.conventions import HANDS, ORDERS, Conventions
from wearcap.io.devices.headset_axes import CONVENTIONS, HeadsetLog, in_our_axes
from wearcap.io.devices.headset_tables import RawPoses
from wearcap.io.formats.poses import are_rotations, check_finite, checked_trajectory
from wearcap.io.formats.trajectory import UNITS, check_span, time_unit_of

_DEVICES = {
    "head": {"head", "hmd", "headset", "camera", "centereye", "eye", "view", "viewer"},
    "left_wrist": {"left", "l", "lefthand", "leftcontroller", "leftwrist", "lhand"},
    "right_wrist": {"right", "r", "righthand", "rightcontroller", "rightwrist", "rhand"},
}
_POSITION = {"pos", "position", "p", "loc", "location", "translation", "trans", "t", "origin"}
_ROTATION = {"rot", "rotation", "quat", "quaternion", "orientation", "orient", "q", "ori"}
_MATRIX = {"matrix", "mat", "m", "transform"}
_TIME = {
    "time",
    "timestamp",
    "timestamps",
    "t",
    "ts",
    "seconds",
    "sec",
    "elapsed",
    "predicteddisplaytime",
    "displaytime",
}
_OTHER = {
    "velocity",
    "vel",
    "angular",
    "acceleration",
    "acc",
    "accel",
    "euler",
    "gaze",
    "joystick",
    "thumbstick",
    "trigger",
}
_UNIT_WORDS = {"s": "s", "sec": "s", "seconds": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns"}
_MAX_COLUMNS = LIMITS["log"].items


@dataclass
class _Columns:
    """Places of a device's numbers: of position and quaternion, or of a matrix' rows."""

    position: dict[str, Any] = field(default_factory=dict)
    quaternion: dict[str, Any] = field(default_factory=dict)
    matrix: dict[int, Any] = field(default_factory=dict)
    words: set[str] = field(default_factory=set)

    @property
    def complete(self) -> bool:
        named = set(self.quaternion) in (set("xyzw"), set("0123"))
        return (set(self.position) == set("xyz") and named) or self.as_matrix

    @property
    def as_matrix(self) -> bool:
        """Whether the pose is given as rows of [R | t]."""
        return set(self.matrix) in (set(range(12)), set(range(16)))

    def places(self) -> list[Any]:
        if self.as_matrix:
            return [self.matrix[number] for number in sorted(self.matrix)][:12]
        numbered = all(name.isdecimal() for name in self.quaternion)
        names = "0123" if numbered else "xyzw"
        return [*(self.position[name] for name in "xyz"), *(self.quaternion[name] for name in names)]


def read_headset_log(
    path: str | Path, axes: str = "auto", quaternion: str = "auto", hands: str = "auto", time_unit: str | None = None
) -> HeadsetLog:
    """A headset's log; `axes` (unity, openxr, steamvr), the `quaternion`'s order (xyzw, wxyz), what the `hands`' poses
    are (wrist: OpenXR's hand joint; grip: a controller's), and `time_unit` (s, ms, us, ns) override what is detected.

    Raises WearcapError for a file without a headset's poses and times, numbers that are none, rows of the head that
    repeat or go back in time (named by line), and where nothing in the log determines a convention.
    """
    for name, value, allowed in (
        ("axes", axes, CONVENTIONS),
        ("quaternion", quaternion, ORDERS),
        ("hands", hands, HANDS),
    ):
        if value not in ("auto", *allowed):
            raise WearcapError(f"{name}={value!r}", expected=f"one of auto, {', '.join(allowed)}")
    if time_unit not in (None, *UNITS):
        raise WearcapError(f"time_unit={time_unit!r}", expected=f"one of {', '.join(UNITS)}")
    path = Path(path)
    rows, where = _rows(path)
    names = next(rows)
    time_name, devices = _devices(names, path)
    times, tables, numbers = _tables(rows, names[time_name], devices, where, path)
    check_finite({"time": times}, path, lambda row: f"{where} {numbers[row]}")
    unit = time_unit or time_unit_of(times, _unit_of(time_name), path)
    notes: list[str] = []
    poses: dict[str, RawPoses] = {}
    for joint, table in tables.items():
        seen = _seen(table)
        lost = int((~seen).sum())
        if joint == "head" and not seen.any():
            raise WearcapError("no tracked pose of the headset", path, "positions and quaternions")
        if lost:
            notes.append(f"{joint} is not tracked in {lost} of {len(seen)} rows")
        if seen.sum() < 2 and joint != "head":
            continue
        kept = np.flatnonzero(seen)
        poses[joint] = _path(table[seen], times[seen] * UNITS[unit], devices[joint], path, f"{where} ", numbers[kept])
    check_span(poses["head"].seconds, path, lambda row: f"pose {row + 1} of the head")
    log = in_our_axes(poses, Conventions(axes=axes, quaternion=quaternion, hands=hands), str(path))
    return replace(log, notes=(f"times in {unit}", *notes, *log.notes))


def is_headset_log(path: str | Path) -> bool:
    """Whether a CSV or JSON file names a headset's poses and times; raises WearcapError only for one that cannot be opened."""
    with open_bytes(path) as file:
        begin = file.read(1 << 12)
    if b"\0" in begin:
        return False
    try:
        rows, _ = _rows(Path(path))
        _devices(next(rows), path)
    except (WearcapError, StopIteration):
        return False
    return True


# --- rows and names ------------------------------------------------------------------------------------------------


def _rows(path: Path) -> tuple[Iterator[Any], str]:
    """First the names of the columns, then (number, row by place) of each row; and what a message calls a row."""
    first = next((line.lstrip() for _, line in numbered_lines(path) if line.strip()), "")
    if first.startswith(("{", "[")):
        return _json_rows(path, first), "frame"
    return _csv_rows(path), "line"


def _csv_rows(path: Path) -> Iterator[Any]:
    lines = ((number, line) for number, line in numbered_lines(path) if line.strip() and not line.startswith("#"))
    header = next(lines, None)
    if header is None:
        raise WearcapError("no rows", path, "a header line with column names")
    separator = max(",;\t", key=header[1].count)
    with understood("a header that is no row of names", path, errors=csv.Error):
        names = [name.strip() for name in next(csv.reader([header[1]], delimiter=separator))][:_MAX_COLUMNS]
    yield {name: place for place, name in enumerate(names)}
    for number, line in lines:
        row = line.rstrip("\r\n").split(separator)
        if len(row) < len(names):
            raise WearcapError(f"line {number} has {len(row)} fields", path, f"{len(names)}, as the header")
        yield number, row


def _json_rows(path: Path, first: str) -> Iterator[Any]:
    """Frames of a JSON list, of the longest list of objects in an object, or of one object a line."""
    by_line = first.startswith("{") and first.rstrip().endswith("}") and _several(path)
    frames: Iterable[Any]
    if by_line:
        frames = (parse_json(line, f"{path}, line {number}") for number, line in numbered_lines(path) if line.strip())
    else:
        content = read_json(path)
        if isinstance(content, dict):
            lists = [value for value in content.values() if isinstance(value, list)]
            content = max(lists, key=len, default=[])
        frames = content if isinstance(content, list) else []
    iterator = iter(frames)
    begin = list(islice(iterator, 50))
    if not begin or not all(isinstance(frame, dict) for frame in begin):
        raise WearcapError("no frames", path, "a list of objects with the poses of a headset")
    names: dict[str, None] = {}
    for frame in begin:
        names |= dict.fromkeys(_flat(frame))
    yield {name: name for name in names}
    number = 0
    for frames in (begin, iterator):
        for frame in frames:
            number += 1
            if not isinstance(frame, dict):
                raise WearcapError(f"frame {number} is a {type(frame).__name__}", path, "an object with poses")
            yield number, _flat(frame)


def _several(path: Path) -> bool:
    return sum(1 for _ in islice((1 for _, line in numbered_lines(path) if line.strip()), 2)) > 1


def _flat(value: Any, key: str = "", depth: int = 0) -> dict[str, Any]:
    """Numbers of nested objects and short arrays by dotted name; the arrays' places are their last part."""
    if depth > 8:
        return {}
    if isinstance(value, list):
        value = dict(enumerate(value)) if len(value) in (3, 4, 12, 16) else {}
    if not isinstance(value, dict):
        return {key: value}
    found: dict[str, Any] = {}
    for name, item in value.items():
        found |= _flat(item, f"{key}.{name}" if key else str(name), depth + 1)
        if len(found) > _MAX_COLUMNS:
            break
    return found


def _parts(name: str) -> list[str]:
    """Lower-case words and numbers of a column's name; a unit in brackets is left out."""
    plain = re.sub(r"[\[(][^\[\]()]*[\])]", " ", name)
    split = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", plain)
    return [word.lower() for word in re.findall(r"[A-Za-zµ]+|\d+", split)]


def _devices(names: dict[str, Any], where: str | Path) -> tuple[str, dict[str, _Columns]]:
    """Name of the column of time, and each device's columns by joint; a head with a pose is required."""
    found = {joint: _Columns() for joint in ("head", *WRISTS)}
    times: list[tuple[int, str]] = []
    for name in names:
        parts = _parts(name)
        device = _device_of(parts)
        if device is None:
            if set(parts) & _TIME:
                times.append((len(parts), name))
            continue
        _sort_in(found[device], name, names[name], parts)
    missing = [joint for joint, columns in found.items() if not columns.complete]
    if "head" in missing or not times:
        what = "no column of time" if "head" not in missing else "no pose of a headset"
        shown = ", ".join(list(names)[:8])
        expected = "time, head_pos_x … z, head_rot_x … w, and the same for left and right"
        raise WearcapError(f"{what} among the columns {shown}"[:300], where, expected)
    return min(times)[1], {joint: columns for joint, columns in found.items() if joint not in missing}


def _device_of(parts: Sequence[str]) -> str | None:
    for joint, words in (("left_wrist", _DEVICES["left_wrist"]), ("right_wrist", _DEVICES["right_wrist"])):
        if set(parts[:-1]) & words:
            return None if "eye" in parts else joint
    return "head" if set(parts[:-1]) & _DEVICES["head"] else None


def _sort_in(columns: _Columns, name: str, place: Any, parts: list[str]) -> None:
    """Enter a column under its quantity and component."""
    words, last = set(parts[:-1]), parts[-1]
    if words & _OTHER:
        return
    joints = {"thumb", "index", "middle", "ring", "little", "pinky", "palm", "tip", "metacarpal", "elbow"}
    if words & joints:
        return
    glued = re.fullmatch(r"(pos|position|p|rot|rotation|quat|q|m)([xyzw]|\d\d?)", last)
    if glued:
        words, last = words | {glued[1]}, glued[2]
    if words & _MATRIX and last.isdecimal():
        number = (
            4 * int(last[0]) + int(last[1])
            if len(last) == 2 and name.lower().rstrip().endswith("m" + last)
            else int(last)
        )
        columns.matrix.setdefault(number, place)
    elif last in ("x", "y", "z", "w") or last.isdecimal():
        axis = last if not last.isdecimal() else ("xyz"[int(last)] if int(last) < 3 else "")
        if words & _ROTATION or last == "w":
            columns.quaternion.setdefault(last, place)
        elif (words & _POSITION or last in "xyz") and axis:
            columns.position.setdefault(axis, place)
    columns.words |= set(parts)


def _unit_of(name: str) -> str | None:
    """Unit that a column's name gives, in brackets or as its last word."""
    found = re.search(r"[\[(]\s*(\w+)\s*[\])]", name)
    words = _parts(name)
    return _UNIT_WORDS.get(found[1].lower()) if found else _UNIT_WORDS.get(words[-1]) if len(words) > 1 else None


# --- numbers -------------------------------------------------------------------------------------------------------


def _tables(
    rows: Iterator[Any], time_place: Any, devices: dict[str, _Columns], where: str, path: Path
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Times, each device's numbers, and the rows' numbers; what is missing is NaN, a row without time is left out."""
    places = {joint: columns.places() for joint, columns in devices.items()}
    times, numbers, values = array("d"), array("q"), {joint: array("d") for joint in devices}
    for number, row in rows:
        read = row.get if isinstance(row, dict) else row.__getitem__
        label = f"{where} {number}"
        time = _value(read(time_place), "time", label, path)
        if math.isnan(time) and isinstance(row, dict):
            continue  # a frame of another kind
        times.append(time)
        numbers.append(number)
        for joint, wanted in places.items():
            values[joint].extend([_value(read(place), joint, label, path) for place in wanted])
    if not times:
        raise WearcapError("a header, but no rows", path, "a row for each frame")
    tables = {joint: np.asarray(column).reshape(len(times), -1) for joint, column in values.items()}
    return np.asarray(times), tables, np.asarray(numbers)


def _value(value: Any, name: str, label: str, path: Path) -> float:
    """A field as a number; empty ones are NaN."""
    if isinstance(value, str):
        value = value.strip()
    if value is None or value == "":
        return math.nan
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise WearcapError(f"{label}: {str(value)[:30]!r} of {name} is no number", path, "numbers") from error


def _seen(table: np.ndarray) -> np.ndarray:
    """Rows with a pose: finite, and not the zeros that runtimes write for what they do not see."""
    finite = (np.abs(table) < 1e6).all(1)
    if table.shape[1] == 12:
        return finite & (np.abs(np.linalg.norm(table.reshape(-1, 3, 4)[:, :, 0], axis=1) - 1) < 0.5)
    lost = (table[:, :3] == 0).all(1) & (np.isclose(np.abs(table[:, 3:]).max(1), 1) | (table[:, 3:] == 0).all(1))
    return finite & ~lost & (np.abs(np.linalg.norm(table[:, 3:], axis=1)) > 0.5)


def _path(
    table: np.ndarray, seconds: np.ndarray, columns: _Columns, path: Path, label: str, numbers: np.ndarray
) -> RawPoses:
    """A device's path as it stands in the log; rows are named by their numbers."""
    name = lambda row: f"{label}{numbers[row]}"  # noqa: E731
    kind = "wrist" if "wrist" in columns.words else None
    if columns.as_matrix:
        rows = table.reshape(-1, 3, 4)
        checked_trajectory(seconds, rows[:, :, 3], np.tile([1.0, 0.0, 0.0, 0.0], (len(table), 1)), path, name)
        if not are_rotations(torch.tensor(rows[:, :, :3]), 0.1).all():
            raise WearcapError("matrices that are no rotations", path, "rows of [R | t], orthogonal within 5 %")
        return RawPoses(seconds, rows[:, :, 3], rows[:, :, :3], None, kind)
    checked_trajectory(seconds, table[:, :3], table[:, 3:], path, name)
    named = next((order for order in ORDERS if order in columns.words), None)
    order = "xyzw" if "x" in columns.quaternion else named
    return RawPoses(seconds, table[:, :3], table[:, 3:], order, kind)
