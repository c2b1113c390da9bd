"""Logs of headsets (OpenXR applications, Unity, SteamVR): poses of the head and of two hands or controllers.

A log is a CSV or JSON file, a replay of Beat Saber, or a session's folder with a file per device (UXF's with one per
tracker and trial, too). Rows in which a hand is not tracked are left out of its path. Who wore it is not read.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from wearcap.body.hands import PALM
from wearcap.boundary.opening import open_bytes
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO, DETECTED, Conventions
from wearcap.io.devices.headset_axes import CONVENTIONS, HeadsetLog, in_our_axes
from wearcap.io.devices.headset_poses import ARKIT, UNITY_ANGLES, UNREAL_ANGLES, Fingers, raw_poses
from wearcap.io.devices.headset_tables import (
    DeviceRows,
    PoseColumns,
    RawPoses,
    device_named,
    has_poses,
    parts_of,
    read_rows,
)
from wearcap.io.formats.bsor import is_bsor, read_bsor
from wearcap.io.formats.times import UNITS
from wearcap.recording.recording import FingerStream

__all__ = ["HeadsetLog", "is_headset_log", "is_headset_session", "read_headset_log"]
_TABLES = {".csv", ".tsv", ".txt", ".json", ".jsonl"}
_MOST_FILES = 2000
_AXES_OF_NAMES = (({"hololens"}, "openxr"), ({"viewer", "orientation"}, "openxr"), (ARKIT, "openxr"))
"""Conventions that a recorder fixes, by words of its columns: HoloLens2ForCV's, WebXR's, visionOS'."""
_AXES_OF_ANGLES = {UNITY_ANGLES: ("unity", "openxr", "steamvr"), UNREAL_ANGLES: ("unreal",)}
_TRIAL = re.compile(r"(?i)_?(?:t|trial_?)\d+$")


def read_headset_log(path: str | Path, how: Conventions = DETECTED, time_unit: str | None = None) -> HeadsetLog:
    """A headset's log; what `how` states of its conventions, and `time_unit` (s, ms, us, ns), override what is detected.

    Trials of a session are one recording, with gaps between them. Raises WearcapError for a file without a headset's
    poses and times, numbers that are none, and where nothing in the log determines a convention.
    """
    poses, fingers, convention, notes = read_raw_poses(Path(path), time_unit, how.axes)
    log = in_our_axes(poses, how, str(path), convention)
    for angles, allowed in _AXES_OF_ANGLES.items():
        if angles in notes and log.axes not in allowed:
            fix = "Say which axes the log has (axes=unity|unreal|openxr), or log quaternions."
            raise WearcapError(f"{angles}, but axes {log.axes}", path, f"axes {', '.join(allowed)}", fix)
    hands = {}
    for side, (seconds, places) in fingers.items():
        points = (log.unit_m * torch.from_numpy(places) @ CONVENTIONS[log.axes].double().mT).float()
        valid = points[:, PALM, :].isfinite().all(-1).all(-1)
        hands[side] = FingerStream(torch.from_numpy(seconds), points, valid, valid.float())
    return replace(log, fingers=hands, notes=(*notes, *log.notes))


def read_raw_poses(
    path: Path, time_unit: str | None = None, axes: str = AUTO
) -> tuple[dict[str, RawPoses], Fingers, str | None, list[str]]:
    """Poses and hands' joints of a log as they stand there, the axes that its format fixes, and notes. Raises as `read_headset_log` does."""
    if time_unit not in (None, *UNITS):
        raise WearcapError(f"time_unit={time_unit!r}", expected=f"one of {', '.join(UNITS)}")
    convention, notes = None, []
    if path.is_dir():
        files, by_trials = _session(path)
        if "head" not in files:
            raise WearcapError("no session of a headset", path, "a file per device: head, left, right")
        rows = {joint: _joined([read_rows(file, joint)[joint] for file in files[joint]], path) for joint in files}
        if by_trials:
            convention, count = "unity", len(files["head"])
            notes = [f"{count} trials of a UXF session in one recording" if count > 1 else "a trial of a UXF session"]
    elif is_bsor(path):
        rows, convention, time_unit = _replay(path), "unity", "s"
    else:
        rows = read_rows(path)
        convention = next((axes for words, axes in _AXES_OF_NAMES if words <= rows["head"].columns.words), None)
    poses, fingers, mended = raw_poses(rows, time_unit, axes, path)
    usual = next((allowed[0] for angles, allowed in _AXES_OF_ANGLES.items() if angles in mended), None)
    return poses, fingers, convention or usual, mended + notes


def is_headset_log(path: str | Path) -> bool:
    """Whether a file names a headset's poses and times; raises WearcapError only for one that cannot be opened."""
    with open_bytes(path) as file:
        begin = file.read(1 << 12)
    return is_bsor(Path(path)) if b"\0" in begin else has_poses(Path(path))


def is_headset_session(folder: str | Path) -> bool:
    """Whether a folder holds a session of a headset: a file per device, of the head at least."""
    return Path(folder).is_dir() and "head" in _session(Path(folder))[0]


def _session(folder: Path) -> tuple[dict[str, list[Path]], bool]:
    """Files of each device in the order of their trials, and whether they are UXF's; none where two claim one device."""
    trackers = folder / "trackers"
    files: dict[str, list[Path]] = {}
    for file in sorted((trackers if trackers.is_dir() else folder).iterdir())[:_MOST_FILES]:
        joint = device_named(parts_of(_TRIAL.sub("", file.name.split(".")[0])))
        if joint and file.is_file() and set(file.suffixes) & _TABLES and has_poses(file, joint):
            files.setdefault(joint, []).append(file)
    trials = all(_TRIAL.search(file.name.split(".")[0]) for of in files.values() for file in of)
    if not trials and any(len(of) > 1 for of in files.values()):
        return {}, False
    return dict(sorted(files.items())), bool(files) and trials


def _joined(parts: list[DeviceRows], path: Path) -> DeviceRows:
    """Rows of trials one after the other; the columns of times that all of them have."""
    first = parts[0]
    if any(part.values.shape[1] != first.values.shape[1] for part in parts):
        raise WearcapError("trials of different columns", path, "the same columns in each")
    return replace(
        first,
        values=np.concatenate([part.values for part in parts]),
        clocks={
            name: np.concatenate([part.clocks[name] for part in parts])
            for name in first.clocks
            if all(name in part.clocks for part in parts)
        },
        rows=np.concatenate([part.rows for part in parts]),
    )


def _replay(path: Path) -> dict[str, DeviceRows]:
    """Rows of head and sabers."""
    seconds, poses = read_bsor(path)
    columns = PoseColumns("quaternion", (), frozenset({"saber"}), "xyzw")
    clocks, rows = {"time": seconds}, np.arange(1, len(seconds) + 1)
    return {
        joint: DeviceRows(columns, poses[:, k], clocks, frozenset(), rows, "frame")
        for k, joint in enumerate(("head", "left_wrist", "right_wrist"))
    }
