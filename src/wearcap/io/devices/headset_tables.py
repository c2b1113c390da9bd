"""Tables of headsets' logs, CSV or JSON: their rows, what their columns are, and the numbers of each device's poses.

Names of columns are taken apart ("head_pos_x", "headPosX", "HMD.position.x", "LeftController Rotation W"): a device (head,
left or right), a quantity (position, quaternion, Euler angles, matrix) and a component. JSON is an object or a list of
frames, or one object a line; nested keys become such names, and arrays of 3, 4, 7, 12 or 16 numbers their components, as do
the vectors of a CSV's field. In a table of the long form a column names the device of each row.
"""

import csv
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from wearcap.body.hands import OPENXR
from wearcap.body.skeleton import SIDES, WRISTS
from wearcap.boundary.limits import LIMITS
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import numbered_lines, parse_json, read_json
from wearcap.errors import WearcapError
from wearcap.io.devices.headset_fingers import FingerColumns, finger_columns
from wearcap.io.formats.times import moment

_DEVICES = {
    "left_wrist": {"left", "l", "lefthand", "leftcontroller", "leftwrist", "lhand"},
    "right_wrist": {"right", "r", "righthand", "rightcontroller", "rightwrist", "rhand"},
    "head": {"head", "hmd", "headset", "camera", "centereye", "eye", "view", "viewer", "deviceanchor"},
}
_POSITION = {"pose", "pos", "position", "p", "loc", "location", "translation", "trans", "t", "origin"}
_ROTATION = {"rot", "rotation", "quat", "quaternion", "orientation", "orient", "q", "ori"}
_EULER = {"euler", "angle", "angles"}
_MATRIX = {"matrix", "mat", "m", "transform"}
_ROTATOR = {"pitch": "0", "yaw": "1", "roll": "2"}
_TRACKED = {"tracked", "istracked", "valid", "isvalid", "available"}
_TIME = {
    "time", "timestamp", "timestamps", "t", "ts", "seconds", "sec", "elapsed", "predicteddisplaytime",
    "displaytime", "unixtime", "unix", "ticks", "filetime", "datetime", "clock", "utc", "epoch"
}  # fmt: skip
_OTHER = {
    "velocity", "vel", "angular", "acceleration", "acc", "accel", "gaze", "joystick", "thumbstick", "trigger",
    "thumb", "index", "middle", "ring", "little", "pinky", "palm", "tip", "metacarpal", "elbow", "shoulder", "foot",
    "ankle", "toe", "knee", "hip", "leg"
}  # fmt: skip
_FALSE = ("0", "0.0", "false")
_LABELS = {
    "device", "name", "tracker", "id", "node", "object", "source", "type", "role", "hand", "handedness", "sensor",
    "label", "joint"
}  # fmt: skip
_MAX_COLUMNS = LIMITS["log"].items
_SIZES = (3, 4, 7, 12, 16)
"""Numbers of a position or Euler angles, a quaternion, both, and matrices."""
_LOOKED_AT = 200
"""Rows of which the layout follows."""
_HOLOLENS = 18 + 26 * 16 + 1 + 26 * 16
"""Fields before the gaze in a row of HoloLens2ForCV's head_hand_eye.csv: time, head, and 26 joints of each hand."""


@dataclass(frozen=True)
class RawPoses:
    """Poses of one device as they stand in a file."""

    seconds: np.ndarray
    """(n,) s, rising."""
    position: np.ndarray
    """(n, 3) in the file's unit and axes, float64."""
    rotation: np.ndarray
    """(n, 4) quaternions in the file's order, or (n, 3, 3) matrices in the file's axes (Euler angles are matrices)."""
    order: str | None
    """"xyzw" or "wxyz" where the file names it; None: not known, and for matrices."""
    families: tuple[str, ...]
    """What a hand's poses may be of by their names: families of `hand_seats.SEATS`."""


@dataclass(frozen=True)
class PoseColumns:
    """The columns of a device's pose."""

    form: str
    """What follows the position's x, y, z: a "quaternion", "euler" angles, or Unreal's "rotator"; or a whole "matrix"."""
    places: tuple[Any, ...]
    words: frozenset[str]
    """All words of their names."""
    order: str | None
    """Of quaternions, where the names say it."""
    tracked: tuple[Any, ...] = ()
    """Places of flags that are false where the device is lost."""
    fingers: FingerColumns | None = None
    """Of a hand, whose "points" these are: no pose."""


_Layout = tuple[dict[str, Any], Any, dict[str, PoseColumns]]


@dataclass(frozen=True)
class DeviceRows:
    """A device's rows of a file: its numbers as they are laid out, and each column of times."""

    columns: PoseColumns
    values: np.ndarray
    """(n, k) numbers of the columns; what is missing is NaN."""
    clocks: dict[str, np.ndarray]
    """(n,) by column's name, numbers as they stand there, texts as seconds of the day or since 1970."""
    texts: frozenset[str]
    """Columns of times that hold texts."""
    rows: np.ndarray
    """(n,) numbers of lines or frames."""
    where: str
    """What a message calls a row."""


def read_rows(path: Path, device: str | None = None) -> dict[str, DeviceRows]:
    """Rows of each device in a file; a session's file whose columns name no device holds the `device` that is given.

    Raises WearcapError for a file without times and a headset's poses, and for fields that are no numbers.
    """
    rows, where = _rows(path)
    names, begin = next(rows), list(islice(rows, _LOOKED_AT))
    clocks, label, devices = _layout(names, [row for _, row in begin], path, device)
    numbers, kinds, texts = array("q"), list[str](), set[str]()
    times = {name: array("d") for name in clocks}
    values = {joint: array("d") for joint in devices}
    for number, row in chain(begin, rows):
        read = row.get if isinstance(row, dict) else row.__getitem__
        kind, about = "", f"{where} {number}"
        if label is not None and (kind := device_named(parts_of(str(read(label))))) is None:
            continue
        moments = [moment(read(place), about, path) for place in clocks.values()]
        if all(math.isnan(time) for time, _ in moments):
            continue  # a frame of another kind
        for (name, column), (time, text) in zip(times.items(), moments):
            column.append(time)
            texts |= {name} if text else set()
        numbers.append(number)
        kinds.append(kind)
        for joint, columns in devices.items():
            lost = any(str(read(place)).strip().lower() in _FALSE for place in columns.tracked)
            found = [math.nan if lost else _value(read(place), joint or kind, about, path) for place in columns.places]
            values[joint].extend(found)
    if not numbers or (label is not None and "head" not in kinds):
        raise WearcapError("a header, but no rows of the head with times", path, "a row for each frame")
    tables = {}
    for joint, columns in devices.items():
        table = np.asarray(values[joint]).reshape(len(numbers), -1)
        for kind in dict.fromkeys(kinds):
            kept = np.asarray(kinds) == kind
            moments = {name: np.asarray(column)[kept] for name, column in times.items()}
            rows_of = DeviceRows(columns, table[kept], moments, frozenset(texts), np.asarray(numbers)[kept], where)
            tables[joint or kind] = rows_of
    return tables


def has_poses(path: Path, device: str | None = None) -> bool:
    """Whether a file's first rows name times and poses: of a headset, or of the `device` that a session's file holds."""
    begin: list[Any] = []
    try:
        rows, _ = _rows(path)
        names = next(rows)
        with suppress(WearcapError):  # a damaged row is an error when the file is read
            begin += (row for _, row in islice(rows, _LOOKED_AT))
        _layout(names, begin, path, device)
    except (WearcapError, StopIteration):
        return False
    return True


def parts_of(name: str) -> list[str]:
    """Lower-case words and numbers of a name; a unit in brackets is left out."""
    plain = re.sub(r"[\[(][^\[\]()]*[^\d\[\]()][^\[\]()]*[\])]", " ", name)
    split = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", plain)
    return [word.lower() for word in re.findall(r"[A-Za-zµ]+|\d+", split)]


def device_named(parts: Sequence[str]) -> str | None:
    """The joint whose device some words name, also two of them in one ("device anchor")."""
    words = {*parts, *map("".join, pairwise(parts))}
    if words & _OTHER:
        return None
    named = next((joint for joint, known in _DEVICES.items() if words & known), None)
    return None if named in WRISTS and "eye" in words else named


# --- rows ----------------------------------------------------------------------------------------------------------


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
    separator = max(",;\t|", key=header[1].count)
    with understood("a header that is no row of names", path, errors=csv.Error):
        names = [name.strip() for name in next(csv.reader([header[1]], delimiter=separator))]
    if len(names) >= _HOLOLENS and re.fullmatch(r"\d+", names[0]):
        names, lines = _hololens_names(len(names)), chain([header], lines)
    fields = ((number, _fields(line, separator, path, number)) for number, line in lines)
    begin = list(islice(fields, _LOOKED_AT))
    sizes = [
        max((len(_vector(row[place])) for _, row in begin if place < len(row)), default=0)
        for place in range(len(names))
    ]
    spread = [f"{name}.{k}" if size else name for name, size in zip(names, sizes) for k in range(max(size, 1))]
    yield {name: place for place, name in enumerate(spread[:_MAX_COLUMNS])}
    for number, row in chain(begin, fields):
        if len(row) < len(names):
            raise WearcapError(f"line {number} has {len(row)} fields", path, f"{len(names)}, as the header")
        if any(sizes):
            parts = ((_vector(text), size) if size else ([text], 1) for text, size in zip(row, sizes))
            row = [text for part, size in parts for text in (part if len(part) == size else [""] * size)]
        yield number, row


def _fields(line: str, separator: str, path: Path, number: int) -> list[str]:
    """Fields of a line; a vector in brackets is one."""
    if "(" in line or '"' in line or "[" in line:
        quoted = re.sub(r'"?[(\[]([^()\[\]]*)[)\]]"?', r'"\1"', line.rstrip("\r\n"))
        with understood(f"line {number} is no row of fields", path, errors=csv.Error):
            return next(csv.reader([quoted], delimiter=separator, skipinitialspace=True))
    return line.rstrip("\r\n").split(separator)


def _vector(text: str) -> list[str]:
    """Numbers of a field that holds as many as a pose or a part of it; [] for any other."""
    parts = re.split(r"[;,]?\s+|;", text.strip())
    parts = parts if len(parts) > 1 else text.split(",")
    number = re.compile(r"[-+]?(\d+([.,]\d*)?([eE][-+]?\d+)?|nan|NaN)")
    return parts if len(parts) in _SIZES and all(map(number.fullmatch, parts)) else []


def _hololens_names(count: int) -> list[str]:
    """Names of the columns of head_hand_eye.csv, which has no header: times of Windows, and matrices by rows."""
    names = ["filetime", *(f"hololens_head_m_{k}" for k in range(16))]
    for side in SIDES:
        names += [f"{side}_available", *(f"{side}_{joint}_m_{k}" for joint in OPENXR for k in range(16))]
    return names + [""] * (count - len(names))


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
    for number, frame in enumerate(chain(begin, iterator), 1):
        if not isinstance(frame, dict):
            raise WearcapError(f"frame {number} is a {type(frame).__name__}", path, "an object with poses")
        yield number, _flat(frame)


def _several(path: Path) -> bool:
    return sum(1 for _ in islice((1 for _, line in numbered_lines(path) if line.strip()), 2)) > 1


def _flat(value: Any, key: str = "", depth: int = 0) -> dict[str, Any]:
    """Numbers of nested objects and short arrays by dotted name; the arrays' places are their last part.

    Objects in a list are keyed by what names their device ("handedness").
    """
    if depth > 8:
        return {}
    if isinstance(value, str):
        value = dict(enumerate(_vector(value))) or value
    if isinstance(value, list):
        if value and all(isinstance(item, dict) for item in value):
            words = (
                (
                    item,
                    [
                        str(word)
                        for name, word in item.items()
                        if name.lower() in _LABELS and not isinstance(word, dict)
                    ],
                )
                for item in value[: len(OPENXR)]
            )
            value = {" ".join(named): item for item, named in words if named}
        else:
            value = dict(enumerate(value)) if len(value) in _SIZES else {}
    if not isinstance(value, dict):
        return {key: value}
    found: dict[str, Any] = {}
    for name, item in value.items():
        found |= _flat(item, f"{key}.{name}" if key else str(name), depth + 1)
        if len(found) > _MAX_COLUMNS:
            break
    return found


# --- columns -------------------------------------------------------------------------------------------------------


def _layout(names: dict[str, Any], begin: Sequence[Any], where: Path, device: str | None) -> _Layout:
    """Places of times by name, of the device's name in a table of the long form, and each device's columns.

    They follow from names and some rows; poses of the head, or of the `device`, are required.
    """
    groups: dict[str, dict[tuple[str, str], dict[str, Any]]] = {joint: {} for joint in ("head", *WRISTS, "")}
    clocks, labels = {}, []
    for name, place in names.items():
        parts = parts_of(name)
        joint = device_named(parts[:-1])
        if found := _quantity(name, parts):
            groups[joint or ""].setdefault(found[:2], {}).setdefault(found[2], place)
        elif set(parts) & _TIME and (joint is None or len(parts) == 1):
            clocks[name] = place
        elif joint is None and set(parts) & _LABELS:
            labels.append(place)
    devices = {joint: one for joint, of in groups.items() if (one := _pose_columns(of)) is not None}
    label = None
    if device is not None:
        own = devices.get(device, devices.get(""))
        devices = {} if own is None else {device: own}
    elif "head" in devices:
        devices.pop("", None)
    elif "" in devices:
        read = [(place, row.get(place) if isinstance(row, dict) else row[place]) for row in begin for place in labels]
        label = next((place for place, text in read if device_named(parts_of(str(text))) == "head"), None)
        devices = {} if label is None else {"": devices[""]}
    if not devices or not clocks or (device is None and not {"head", ""} & set(devices)):
        what = "no column of time" if not clocks and devices else "no pose of a headset"
        shown = ", ".join(list(names)[:8])
        expected = "time, head_pos_x … z, head_rot_x … w, and the same for left and right"
        raise WearcapError(f"{what} among the columns {shown}"[:300], where, expected)
    if "head" in devices:
        for side, found in finger_columns((parts_of(name), place) for name, place in names.items()).items():
            wrist = devices.get(f"{side}_wrist")
            tracked = () if wrist is None else wrist.tracked
            devices[f"{side}_fingers"] = PoseColumns("points", found.places, frozenset(), None, tracked, found)
    return clocks, label, devices


def _quantity(name: str, parts: list[str]) -> tuple[str, str, str] | None:
    """What a column is of a device ("position", "rotation", "euler", "rotator", "matrix", "tracked"), the other words of
    its name, and its component."""
    *before, last = parts or [""]
    if set(before) & _OTHER:
        return None
    if last in _TRACKED:
        return "tracked", "", name
    if last in _ROTATOR:
        return "rotator", " ".join(before), _ROTATOR[last]
    if glued := re.fullmatch(r"(pos|position|p|rot|rotation|quat|q|r|m|euler)([xyzw]|\d\d?)", last):
        before, last = [*before, "rot" if glued[1] == "r" else glued[1]], glued[2]
    words, numbered = set(before), last.isdecimal() and len(last) <= 2
    if numbered and before and (words & _MATRIX or before[-1].isdecimal()):
        nested = before[-1].isdecimal()
        pair = before.pop() + last if nested else last if name.lower().rstrip().endswith("m" + last) else ""
        number = 4 * int(pair[0]) + int(pair[1]) if re.fullmatch(r"[0-3]{2}", pair) else int(last)
        return "matrix", " ".join(before), str(number)
    if last not in ("x", "y", "z", "w") and not numbered:
        return None
    kinds = {"euler": words & _EULER, "rotation": words & _ROTATION, "position": words & _POSITION or not numbered}
    kind = next((kind for kind, named in kinds.items() if named), None)
    return (kind, " ".join(before), last) if kind else None


def _pose_columns(groups: dict[tuple[str, str], dict[str, Any]]) -> PoseColumns | None:
    """The first whole pose among a device's columns, grouped by their quantity and the other words of their names."""

    def first(quantity: str, *components: Iterable[str]) -> tuple[list[Any], str, bool] | None:
        for wanted, ((kind, prefix), places) in product(map(list, components), groups.items()):
            whole = set(wanted) <= set(places) if quantity == "position" else set(wanted) == set(places)
            if kind == quantity and whole:
                return [places[name] for name in wanted], prefix, wanted[0] == "x"
        return None

    tracked = tuple(place for (kind, _), places in groups.items() if kind == "tracked" for place in places.values())
    numbers = [str(number) for number in range(16)]
    for form, sought in {"matrix": ("matrix", numbers, numbers[:12]), "quaternion": ("position", numbers[:7])}.items():
        if found := first(*sought):
            return PoseColumns(form, tuple(found[0]), frozenset(found[1].split()), None, tracked)
    position = first("position", "xyz", "012")
    forms = {
        "quaternion": ("rotation", "xyzw", "0123"),
        "rotator": ("rotator", "012"),
        "euler": ("rotation", "xyz", "012"),
    }
    for form, sought in (*forms.items(), ("euler", ("euler", "xyz", "012"))):
        if position and (found := first(*sought)):
            named = {*position[1].split(), *found[1].split()}
            order = "xyzw" if found[2] else next((one for one in ("xyzw", "wxyz") if one in named), None)
            order = order if form == "quaternion" else None
            return PoseColumns(form, (*position[0], *found[0]), frozenset(named), order, tracked)
    return None


def _value(value: Any, name: str, label: str, path: Path) -> float:
    """A field as a number, also with a decimal comma; empty ones are NaN."""
    text = value.strip() if isinstance(value, str) else value
    if text is None or (isinstance(text, str) and text.lower() in ("", "null", "none", "n/a", "-")):
        return math.nan
    try:
        if isinstance(text, bool):
            raise ValueError
        return float(text.replace(",", ".") if isinstance(text, str) else text)
    except (TypeError, ValueError, OverflowError) as error:
        raise WearcapError(f"{label}: {str(value)[:30]!r} of {name} is no number", path, "numbers") from error
