"""The one reader of trajectories, which knows a file by its content.

TUM: lines of `timestamp tx ty tz qx qy qz qw`. EuRoC: CSV of `#timestamp [ns], p x y z, q w x y z`, more columns may
follow; a header that names its columns decides their order. COLMAP: images.txt or images.bin, poses of the world in the
camera. hloc: lines of `name qw qx qy qz tx ty tz`, likewise. DROID-SLAM: arrays (.npy, .npz) of `tx ty tz qx qy qz qw`;
poses.npy of a reconstruction's folder holds the world in the camera, with tstamps.npy beside. MPS: closed-loop CSV.
KITTI: 12 numbers a line, the first three rows of the camera's matrix in the world, times in times.txt beside; with a
time first, or 4×4 matrices by row or column (ARKit). transforms.json, Record3D's metadata.json: `camera_frames.py`.

Times are checked before anything is made of them: the unit follows from the step between rows (a header's unit and
seconds since 1970 decide where two are possible), and nothing that is spread over a longer time than its rows can
cover is accepted. So whoever resamples a trajectory gets at most ten times its rows.
"""

import math
import os
import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from wearcap.boundary.arrays import read_npy, read_npz
from wearcap.boundary.opening import open_bytes
from wearcap.boundary.texts import numbered_lines
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.camera_frames import NAMES, is_camera_frames, read_camera_frames
from wearcap.io.formats.colmap import read_images
from wearcap.io.formats.csv_table import read_columns
from wearcap.io.formats.pose_columns import (
    EUROC,
    LOST,
    MATRIX_WITHIN,
    STATES,
    TUM,
    first_column,
    is_matrix,
    is_number,
    places_of,
    quaternion_first,
    usual_axes,
    words_of,
)
from wearcap.io.formats.poses import are_rotations, check_finite, checked_trajectory, row_name
from wearcap.io.formats.times import UNITS, check_span, in_order, time_unit_of, unit_named, without_repeats

_FAR, _FAR_FOR_EXTENT, _NOWHERE = 1e4, 20.0, 1e9
"""Distance from zero from which places are a map's, in units and in extents of the path, and from which they are none."""
_FRAMES = 1e6
"""Whole numbers below are frame numbers (nine hours at 30 Hz), larger ones times."""
FORMATS = "TUM, EuRoC, COLMAP's images, hloc's poses, DROID-SLAM's arrays, MPS' closed loop, KITTI, transforms.json"
_FIX = "Lines of `timestamp tx ty tz qx qy qz qw` (TUM) are the simplest."
_MPS = "tracking_timestamp_us", "tx_world_device"


@dataclass(frozen=True)
class TrajectoryFile:
    """A trajectory, and what its file is."""

    trajectory: Trajectory
    format: str
    time_unit: str
    """Unit of the file's times: s, ms, us, ns or frames."""
    of_camera: bool
    """Whether the format's poses are a camera's, with OpenCV's axes; otherwise the file does not name its axes."""
    metric: bool
    """Whether the format's unit of length is the metre; structure from motion and one camera's SLAM know no unit."""
    origin: Float64[np.ndarray, "3"] | None = None
    """What was taken off the positions (file's unit and axes), for maps' coordinates are beyond single precision."""
    notes: tuple[str, ...] = ()
    """Sentences on rows that were sorted or left out."""
    usual: tuple[str, str] | None = None
    """The format's usual axes, up and the device's, for paths that do not show theirs."""


@dataclass(frozen=True)
class _Table:
    """Columns as they stand in a file."""

    format: str
    times: np.ndarray | None
    translation: np.ndarray
    quat_wxyz: np.ndarray
    unit: str | None = None
    """Unit that a header names."""
    inverse: bool = False
    """Whether poses are those of the world in the body."""
    of_camera: bool = False
    metric: bool = True
    usual: tuple[str, str] | None = None
    name: Callable[[int], str] = row_name


def read_trajectory(path: str | Path, time_unit: str | None = None, fps: float | None = None) -> Trajectory:
    """Trajectory in the file's own world and body axes (s; m where the format has metres).

    `time_unit` (s, ms, us, ns) overrides what the numbers say; `fps` is for files with frame numbers or no times.
    Raises WearcapError for a file that is none of the formats or whose rows hold no pose, quaternions far from unit norm
    (named by line), times that are no recording's, and positions at a map's coordinates.
    """
    read = read_trajectory_file(path, time_unit, fps)
    if read.origin is not None:
        what = f"positions at a map's coordinates, {read.origin.round(1).tolist()} from the origin"
        fix = "Take the same offset off it and what shares its world."
        raise WearcapError(what, path, "positions within kilometres of the origin", fix)
    return read.trajectory


def read_trajectory_file(path: str | Path, time_unit: str | None = None, fps: float | None = None) -> TrajectoryFile:
    """A trajectory with its format and unit of time; raises as `read_trajectory` does."""
    if time_unit not in (None, *UNITS):
        raise WearcapError(f"time_unit={time_unit!r}", expected=f"one of {', '.join(UNITS)}")
    if fps is not None and not 0 < fps < 2000:
        raise WearcapError(f"fps={fps}", expected="frames per second, above 0")
    path = _file_of(Path(path))
    table = _read(path)
    if not len(table.translation):
        raise WearcapError("no poses in the file", path, FORMATS)
    if table.inverse:
        table = _inverted(table)
    seconds, unit = _seconds(table, time_unit, fps, path)
    lost = ~np.isfinite(table.translation).all(1) | ~np.isfinite(table.quat_wxyz).all(1)
    lost |= (table.quat_wxyz == 0).all(1)  # as systems write it while tracking is lost
    rows, notes = in_order(seconds, table.translation, ~lost, "a pose (tracking lost)", path, table.name)
    rows, repeated = without_repeats(seconds, table.translation, rows)
    notes += repeated
    if len(rows) < min(2, len(seconds)):
        what = f"{len(rows)} poses in its {len(seconds)} rows; {'; '.join(notes)}"
        raise WearcapError(what, path, "finite numbers, unit quaternions, and times that differ")
    seconds, translation = seconds[rows], table.translation[rows].astype(np.float64)
    origin = map_origin(translation)
    if origin is not None:
        translation = translation - origin
        listed = ", ".join(f"{value:.0f}" for value in origin)
        notes.append(f"positions are at a map's coordinates: ({listed}) is taken off, and kept as the origin")

    def name(row: int) -> str:
        return table.name(int(rows[row]))

    trajectory = checked_trajectory(seconds, translation, table.quat_wxyz[rows], path, name)
    check_span(seconds, path, name)
    return TrajectoryFile(
        trajectory, table.format, unit, table.of_camera, table.metric, origin, tuple(notes), table.usual
    )


def map_origin(translation: Float64[np.ndarray, "pose 3"]) -> Float64[np.ndarray, "3"] | None:
    """Whole numbers amid places, for places much farther from zero than from one another; None for others."""
    low, middle, high = np.quantile(translation, (0.05, 0.5, 0.95), axis=0)  # outliers may lie at zero
    if not max(_FAR, _FAR_FOR_EXTENT * (high - low).max()) < np.abs(middle).max() < _NOWHERE:
        return None
    return np.floor(middle)


def trajectory_format(path: str | Path) -> str | None:
    """Format of a file that looks like a trajectory, by its beginning alone; None for any other file.

    Raises WearcapError for a file that cannot be opened.
    """
    path = Path(path)
    with open_bytes(path) as file:
        begin = file.read(6)
    if begin.startswith((b"\x93NUMPY", b"PK")) or path.name == "images.bin":
        return "COLMAP" if path.name == "images.bin" else "DROID-SLAM" if path.suffix == ".npy" else None
    try:
        return "NeRF" if is_camera_frames(path) else _kind(_first_lines(path))[0]
    except WearcapError:
        return None


_IN_FOLDERS = (
    *(f"{part}images.{kind}" for part in ("", "sparse/0/", "sparse/", "colmap/sparse/0/") for kind in ("bin", "txt")),
    *("poses.npy", *NAMES),
    *(f"{part}closed_loop_trajectory.csv{packed}" for part in ("", "slam/") for packed in ("", ".gz", ".xz")),
    *("mav0/state_groundtruth_estimate0/data.csv", "state_groundtruth_estimate0/data.csv", "data.csv"),
    *("trajectory.txt", "traj.txt", "poses.txt", "open_loop_trajectory.csv"),
)
"""Files of a folder that hold its trajectory, the first that is there."""


def trajectory_file(folder: str | Path) -> Path | None:
    """The file in a folder that holds its trajectory, by the formats' usual names; None where there is none."""
    files = (path for name in _IN_FOLDERS if (path := Path(folder) / name).is_file())
    return next((path for path in files if path.suffix != ".json" or is_camera_frames(path)), None)


def _file_of(path: Path) -> Path:
    if not os.path.isdir(path):  # a path that may not be looked at is refused when it is opened
        return path
    found = trajectory_file(path)
    if found is None:
        expected = "images.bin or images.txt (also in sparse/0), poses.npy, transforms.json, trajectory.txt, …"
        raise WearcapError("a folder without a trajectory", path, expected, "Give its file.")
    return found


def _read(path: Path) -> _Table:
    """Columns of a file, by its content."""
    with open_bytes(path) as file:
        begin = file.read(6)
    if not begin:
        raise WearcapError("no poses in the file", path, FORMATS)
    if begin.startswith(b"\x93NUMPY"):
        return _droid(path, read_npy(path), _times_beside(path))
    if begin.startswith(b"PK"):
        return _droid_archive(path)
    if path.name == "images.bin":
        return _from_images(path)
    if is_camera_frames(path):
        record3d, rows = read_camera_frames(path)
        return replace(_of_pictures("Record3D" if record3d else "NeRF", rows, path), metric=record3d)
    first = _first_lines(path)
    kind, header = _kind(first)
    if kind is None:
        _refuse(first, path)
    if kind == "open loop":
        what, expected = "MPS' open-loop odometry, which drifts", "the closed loop, which is registered in one world"
        raise WearcapError(what, path, expected, "Give closed_loop_trajectory.csv of the same output, or its folder.")
    if kind == "MPS":
        return _mps(path)
    if kind == "COLMAP":
        return _from_images(path)
    if kind == "hloc":
        return _hloc(path)
    if kind == "KITTI":
        return _kitti(path)
    return _named_columns(path, kind or "", header)


# --- text ----------------------------------------------------------------------------------------------------------


def _first_lines(path: Path) -> list[tuple[int, str]]:
    """Comments and the first two other lines, with their numbers."""
    found: list[tuple[int, str]] = []
    rows = 0
    for number, line in islice(numbered_lines(path), 100):
        if line.strip():
            found.append((number, line.strip()))
            rows += not line.startswith("#")
        if rows == 2:
            break
    return found


def _kind(first: Sequence[tuple[int, str]]) -> tuple[str | None, dict[str, int] | None]:
    """Format of a text by its first lines, and the places of its columns by name, where a header has them."""
    header = None
    for _, line in first:
        words = words_of(line.lstrip("#").strip())
        comment = line.startswith("#")
        if _MPS[0] in words and _MPS[1] in words:
            return "MPS", None
        if "tx_odometry_device" in words:
            return "open loop", None
        if comment or not any(map(is_number, words)):
            slots = places_of(words)
            if slots is None and not comment:
                return None, None
            header = slots or header
            continue
        numbers = sum(map(is_number, words))
        if header is not None and len(words) > max(header.values()) and is_number(words[header["time"]]):
            return "EuRoC" if "," in line else "TUM", header
        if not is_number(words[0]) and len(words) == 8 and numbers == 7:
            return "hloc", None
        if len(words) >= 10 and "," not in line and all(map(is_number, words[:9])) and not is_number(words[9]):
            return "COLMAP", None
        if (len(words) == 12 and numbers == 12 and "," not in line) or is_matrix(words):
            return "KITTI", None
        if len(words) == 8 and "," not in line:
            return "TUM", None
        if len(words) >= 8 and "," in line and is_number(words[0]):
            return "EuRoC", None
        return None, None
    return None, None


def _named_columns(path: Path, kind: str, header: dict[str, int] | None) -> _Table:
    """TUM's and EuRoC's lines of numbers, and those of any header."""
    slots = header or (EUROC if kind == "EuRoC" else TUM)
    places = [slots[name] for name in ("time", "x", "y", "z", "qw", "qx", "qy", "qz")]
    exact = header is None and kind == "TUM"
    expected = "timestamp tx ty tz qx qy qz qw" if exact else "timestamp, x, y, z, qw, qx, qy, qz in every line"
    values, lines, unit, heading, state = array("d"), array("l"), None, "", None
    for number, line in numbered_lines(path):
        text = line.split("#")[0].strip()
        words = words_of(text or line.lstrip("# \t"))
        if not text or (not values and not any(map(is_number, words))):  # a comment, or a header without #
            unit, heading = unit or unit_named(first_column(line)), heading or line.lower()
            state = next((place for place, word in enumerate(words) if word.lower() in STATES), state)
            continue
        if len(words) != 8 if exact else len(words) <= max(places):
            raise WearcapError(f"line {number} has {len(words)} fields", path, expected)
        try:
            values.extend([float(words[place] or "nan") for place in places])
        except ValueError as error:
            raise WearcapError(f"line {number}: {error}"[:200], path, expected) from error
        if state is not None and state < len(words) and words[state].lower() in LOST:
            values[-1] = math.nan
        lines.append(number)
    table = np.asarray(values).reshape(-1, 8)
    if exact:
        table = quaternion_first(table)
    usual = usual_axes(heading, table[0]) if len(table) else None
    return _Table(kind, table[:, 0], table[:, 1:4], table[:, 4:], unit, usual=usual, name=_by_line(lines))


def _by_line(lines: Sequence[int]) -> Callable[[int], str]:
    return lambda row: f"line {lines[row]}"


def _refuse(first: Sequence[tuple[int, str]], path: Path) -> None:
    """Raise WearcapError for a text that is no trajectory, with the first line that is none."""
    rows = [(number, line) for number, line in first if not line.startswith("#")]
    if not rows:
        raise WearcapError("no poses in the file", path, FORMATS)
    number, line = next(((n, text) for n, text in rows if any(map(is_number, words_of(text)))), rows[0])
    words = words_of(line)
    what = f"line {number} has {len(words)} fields, no pose of a known format" if len(words) < 8 else "not a trajectory"
    raise WearcapError(what, path, FORMATS, _FIX)


def _mps(path: Path) -> _Table:
    columns = [f"{part}_world_device" for part in ("tx", "ty", "tz", "qw", "qx", "qy", "qz")]
    table = read_columns(path, [_MPS[0], *columns])
    pose = np.stack([table[name] for name in columns], 1)
    return _Table("MPS", table[_MPS[0]], pose[:, :3], pose[:, 3:], "us", of_camera=True, name=_after_header)


def _after_header(row: int) -> str:
    return f"line {row + 2}"


def _kitti(path: Path) -> _Table:
    """Rows of [R | t] or of 4×4 matrices; by column they are ARKit's, whose camera looks along -z in a world with y up."""
    values, lines, width = array("d"), array("l"), 0
    for number, line in numbered_lines(path):
        words = words_of(text) if (text := line.split("#")[0].strip()) else []
        width = width or len(words)
        if words and (len(words) != width or not all(map(is_number, words))):
            raise WearcapError(f"line {number} has {len(words)} fields", path, f"{width} numbers in every line")
        if words:
            values.extend(map(float, words))
            lines.append(number)
    table = np.asarray(values).reshape(-1, width)
    times = table[:, 0].copy() if width % 4 else _times_beside(path)
    matrices = table[:, width % 4 :].reshape(len(table), -1, 4)
    by_column = width >= 16 and not (matrices[:, 3] == [0, 0, 0, 1]).all()
    if by_column:
        matrices = matrices.swapaxes(1, 2)
    read = _of_matrices("ARKit" if by_column else "KITTI", matrices[:, :3], times, path, _by_line(lines))
    return replace(read, of_camera=False, usual=("y", "openxr"), metric=True) if by_column else read


# --- names of pictures as times ------------------------------------------------------------------------------------


def _from_images(path: Path) -> _Table:
    images = read_images(path)
    poses = ((image.name, (*image.quaternion_wxyz, *image.translation)) for image in images)
    return _of_pictures("COLMAP", poses, path)


def _hloc(path: Path) -> _Table:
    def rows() -> Iterator[tuple[str, tuple[float, ...]]]:
        for number, line in numbered_lines(path):
            words = line.split("#")[0].split()
            if words and (len(words) != 8 or not all(map(is_number, words[1:]))):
                raise WearcapError(f"line {number} is no pose", path, "name qw qx qy qz tx ty tz")
            if words:
                yield words[0], tuple(map(float, words[1:]))

    return _of_pictures("hloc", rows(), path)


def _of_pictures(kind: str, rows: Iterator[tuple[str, tuple[float, ...]]], path: Path) -> _Table:
    """Poses of the world in the pictures' cameras, in the order of the times in their names."""
    names: list[str] = []
    values, times = array("d"), array("d")
    whole = True
    for name, pose in rows:
        text = _last_number(name)
        if text is None:
            fix = "Name the pictures after their times or frame numbers."
            raise WearcapError(
                f"picture {name[:60]!r} has no number in its name", path, "times, such as 12.345.png", fix
            )
        names.append(name)
        times.append(float(text))
        values.extend(pose)
        whole &= text.isdecimal() and float(text) < _FRAMES
    order = np.argsort(np.asarray(times), kind="stable")
    table = np.asarray(values).reshape(-1, 7)[order]
    return _Table(
        kind,
        np.asarray(times)[order],
        table[:, 4:],
        table[:, :4],
        "frames" if whole else None,
        inverse=True,
        of_camera=True,
        metric=False,
        name=lambda row: f"picture {names[order[row]]!r}",
    )


def _last_number(name: str) -> str | None:
    stem = re.sub(r"\.[A-Za-z]\w{1,4}$", "", name.rsplit("/", 1)[-1])
    found = re.findall(r"\d+(?:\.\d+)?", stem[-200:])
    return found[-1] if found else None


# --- arrays --------------------------------------------------------------------------------------------------------

_TIMES = ("tstamps", "tstamp", "timestamps", "times")
_POSES = ("traj_est", "traj", "trajectory", "poses", "cam_c2w", "arr_0")


def _droid_archive(path: Path) -> _Table:
    arrays = read_npz(path, (*_POSES, *_TIMES))
    poses = next((name for name in _POSES if name in arrays), None)
    if poses is None:
        raise WearcapError("no array of poses", path, f"one of {', '.join(_POSES)}")
    times = next((arrays[name] for name in _TIMES if name in arrays), None)
    return _droid(path, arrays[poses], times, inverse=poses == "poses")


def _droid(path: Path, poses: np.ndarray, times: np.ndarray | None, inverse: bool | None = None) -> _Table:
    """DROID-SLAM's arrays: with the scalar last; those of a reconstruction are the world's in the camera."""
    if poses.dtype.kind not in "fiu" or (times is not None and times.dtype.kind not in "fiu"):
        raise WearcapError(f"an array of {poses.dtype}"[:80], path, "real numbers")
    if inverse is None:
        inverse = path.name == "poses.npy" and (path.parent / "disps.npy").is_file()
    if times is not None:
        times = times.astype(np.float64).ravel()
    if poses.ndim == 3 and poses.shape[1:] in ((3, 4), (4, 4)):
        return _of_matrices("DROID-SLAM", poses[:, :3], times, path, row_name)
    if poses.ndim == 2 and poses.shape[1] == 8 and times is None:
        times, poses = poses[:, 0].astype(np.float64), poses[:, 1:]
    if poses.ndim != 2 or poses.shape[1] != 7:
        what = f"an array of shape {poses.shape}"
        raise WearcapError(what, path, "(poses, 7): tx ty tz qx qy qz qw; or (poses, 8) with times; or 4×4 matrices")
    _same_length(times, len(poses), path)
    poses, frames = poses.astype(np.float64), times is not None and bool((times == np.floor(times)).all())
    unit = "frames" if frames and times is not None and np.abs(times).max(initial=0) < _FRAMES else None
    quat_wxyz = poses[:, [6, 3, 4, 5]]
    return _Table("DROID-SLAM", times, poses[:, :3], quat_wxyz, unit, inverse=inverse, of_camera=True, metric=False)


def _of_matrices(
    kind: str, matrices: np.ndarray, times: np.ndarray | None, path: Path, name: Callable[[int], str]
) -> _Table:
    """Rows of [R | t], the camera's pose in the world."""
    _same_length(times, len(matrices), path)
    matrices = matrices.astype(np.float64)
    check_finite({"matrix": matrices}, path, name)
    R = torch.from_numpy(np.ascontiguousarray(matrices[:, :, :3]))
    bad = (~are_rotations(R, MATRIX_WITHIN)).numpy()
    if bad.any():
        what = f"{name(int(bad.argmax()))} is no rotation and translation ({int(bad.sum())} such rows)"
        raise WearcapError(what, path, "[R | t], three rows of four numbers")
    quat = quat_wxyz_from_matrix(R).numpy()
    unit = "frames" if times is None else None
    return _Table(kind, times, matrices[:, :, 3], quat, unit, of_camera=True, metric=kind == "KITTI", name=name)


def _times_beside(path: Path) -> np.ndarray | None:
    """Times in a file of its own beside the poses; None where there is none."""
    for name in _TIMES:
        for suffix in (".npy", ".txt"):
            file = path.with_name(name + suffix)
            if file == path or not file.is_file():
                continue
            if suffix == ".npy":
                return read_npy(file)
            numbers = chain.from_iterable(line.split("#")[0].split() for _, line in numbered_lines(file))
            try:
                return np.asarray(array("d", map(float, numbers)))
            except ValueError as error:
                raise WearcapError(
                    f"a time that is no number ({error})"[:120], file, "one number in each line"
                ) from error
    return None


def _same_length(times: np.ndarray | None, count: int, path: Path) -> None:
    if times is not None and len(times) != count:
        raise WearcapError(f"{len(times)} times of {count} poses", path, "one time for each pose")


# --- times ---------------------------------------------------------------------------------------------------------


def _inverted(table: _Table) -> _Table:
    """The bodies' poses in the world, of those of the world in the body."""
    R = matrix_from_quat_wxyz(torch.from_numpy(np.ascontiguousarray(table.quat_wxyz))).numpy()
    center = -np.einsum("nji,nj->ni", R, table.translation)
    return replace(table, translation=center, quat_wxyz=table.quat_wxyz * np.array([1, -1, -1, -1]), inverse=False)


def _seconds(table: _Table, time_unit: str | None, fps: float | None, path: Path) -> tuple[np.ndarray, str]:
    """Times in seconds, and the unit that they have in the file."""
    times, count = table.times, len(table.translation)
    if times is None or (table.unit == "frames" and time_unit is None):
        if fps is None:
            what = "frame numbers instead of times" if times is not None else "poses without times"
            raise WearcapError(what, path, "times of the poses", "Give the video's rate: fps=30.")
        return (np.arange(count) if times is None else times) / fps, "frames"
    unit = time_unit or time_unit_of(times, table.unit, path)
    # Whole nanoseconds since 1970 are beyond a float's 53 bits; what is lost is below a microsecond.
    return times * UNITS[unit], unit
