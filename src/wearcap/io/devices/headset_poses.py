"""From rows to poses: which clock counts, which rows are poses, and what of a recording all devices are tracked in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from wearcap.errors import WearcapError
from wearcap.io.devices.hand_seats import families_named
from wearcap.io.devices.headset_tables import DeviceRows, RawPoses, parts_of
from wearcap.io.formats.times import check_span, evenly_spread, grain, in_order, in_seconds, without_repeats

Fingers = dict[str, tuple[np.ndarray, np.ndarray]]
"""By side, times (n,) s and places (n, joint, 3) of a hand's joints in the file's unit and axes."""

ARKIT = {"origin", "from", "anchor"}
"""Words of visionOS' anchors; those of hands have axes of their own."""
UNITY_ANGLES = "Euler angles in degrees, about z, x and y in turn as Unity's"
UNREAL_ANGLES = "pitch, yaw and roll in degrees as Unreal's"
FILLED_S = 1.0
"""Longest gap in the head's tracking that is interpolated."""
LATE_S = 0.5
"""How much later a hand may be tracked than the head, or be lost before it."""
FROZEN_S = 0.5
"""How long a hand may keep a pose to the last digit while the head moves; afterwards it counts as lost."""
_MOST = 0.5
"""Least share of a recording that remains when it is cut to where a hand is tracked."""
_TOLERANCE = 0.02, 0.1
"""Largest deviations from rotations: of a quaternion's norm from 1, and of a matrix times its transpose."""


def raw_poses(
    rows: dict[str, DeviceRows], time_unit: str | None, axes: str, path: Path
) -> tuple[dict[str, RawPoses], Fingers, list[str]]:
    """Poses of the devices over the time in which all of them are tracked, hands by side, and notes of what was mended.

    The stated `axes` decide what Euler angles mean: x, y, z are Unity's unless Unreal's are stated, and pitch, yaw, roll
    Unreal's unless Unity's are.
    Raises WearcapError for times that are none, for a head without two poses, and for rotations that are none.
    """
    hands = {joint[:-8]: (found, table.values) for joint, table in rows.items() if (found := table.columns.fingers)}
    rows = {joint: table for joint, table in rows.items() if not table.columns.fingers}
    clock, poses, fingers = _clock(rows, time_unit, path), dict[str, RawPoses](), Fingers()
    notes, shared = [f"times {_seconds(rows['head'], clock, time_unit, path)[1]} ({clock})"], None
    notes += _angles(rows, axes, path)
    for joint, table in sorted(rows.items()):  # the head first
        if joint != "head" and table.columns.words >= ARKIT:
            notes.append(f"{joint} is left out: visionOS' hand anchors have axes of their own")
            continue
        position, rotation = _parts(table, axes, path)
        seen, times = _seen(position, rotation), table.clocks[clock]
        if shared is None or not np.array_equal(times, rows["head"].clocks[clock], equal_nan=True):
            seconds, shown = _seconds(table, clock, time_unit, path)[0], np.where(seen[:, None], position, np.nan)
            seconds, kept, mended = _in_order(seconds, shown, table, path)
            notes += [f"{joint}: {note}" for note in mended]
            shared = shared or (seconds, kept)
        else:
            seconds, kept = shared
        seen = seen[kept]
        _check_rotations(rotation[kept][seen], table.rows[kept][seen], f"{table.where} ", path)
        families = families_named(table.columns.words)
        pose = RawPoses(seconds, position[kept], rotation[kept], table.columns.order, families)
        notes += _tracked(pose, seen, joint, poses)
        poses[joint] = _of_rows(pose, seen)
        if len(poses["head"].seconds) < 2:
            raise WearcapError("no two tracked poses of the headset", path, "positions and rotations")
        for side, (found, values) in hands.items() if joint == "head" else ():  # in the same file's rows
            points = found.points(values)[kept]
            shown = RawPoses(seconds, points[:, 0], np.nan_to_num(points), None, ())
            points[_frozen(shown, poses["head"])] = np.nan
            fingers[side] = seconds, points
    check_span(poses["head"].seconds, path, lambda row: f"pose {row + 1} of the head")
    return _together(poses, notes), fingers, notes


def _in_order(
    seconds: np.ndarray, position: np.ndarray, table: DeviceRows, path: Path
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Times (m,) that rise, the rows (m,) that they are of, and notes; a clock that is coarser than the rows is spread."""
    whole = np.ones(len(seconds), dtype=bool)
    order, notes = in_order(seconds, position, whole, "a time", path, lambda row: f"{table.where} {table.rows[row]}")
    if spread := evenly_spread(seconds, position, order):
        return spread[0], order, notes + spread[1]
    kept, repeated = without_repeats(seconds, position, order)
    return seconds[kept], kept, notes + repeated


def _of_rows(pose: RawPoses, kept: np.ndarray) -> RawPoses:
    return replace(pose, seconds=pose.seconds[kept], position=pose.position[kept], rotation=pose.rotation[kept])


# --- times ---------------------------------------------------------------------------------------------------------


def _seconds(table: DeviceRows, clock: str, time_unit: str | None, path: Path) -> tuple[np.ndarray, str]:
    return in_seconds(table.clocks[clock], clock, clock in table.texts, time_unit, path)


def _clock(rows: dict[str, DeviceRows], time_unit: str | None, path: Path) -> str:
    """The column of times that all devices share, that rises, has the plainest name, and the finest grain."""
    shared = [name for name in rows["head"].clocks if all(name in table.clocks for table in rows.values())]
    if not shared:
        raise WearcapError("the devices' files share no column of times", path, "one clock for all")

    def rank(name: str) -> tuple[bool, int, int, str]:
        try:
            seconds = _seconds(rows["head"], name, time_unit, path)[0]
        except WearcapError:
            return True, 0, 0, name
        steps = np.diff(seconds)
        rises = len(steps) > 0 and (steps > 0).mean() > 0.95
        return not rises, len(parts_of(name)), -grain(seconds[np.isfinite(seconds)]), name

    return min(shared, key=rank)


# --- poses ---------------------------------------------------------------------------------------------------------


def _unreal(form: str, axes: str) -> bool:
    return axes == "unreal" or (form == "rotator" and axes != "unity")


def _angles(rows: dict[str, DeviceRows], axes: str, path: Path) -> list[str]:
    """A note on Euler angles, if there are any. Raises WearcapError for those that may be radians, and for
    Unreal's where the head is not above the hands along z, or without hands does not move least along it."""
    tables = [table for table in rows.values() if table.columns.form in ("euler", "rotator")]
    if not tables:
        return []
    widest = max(float(np.nanmax(np.abs(table.values[:, 3:]), initial=0.0)) for table in tables)
    if widest <= 2 * np.pi and not any(table.columns.words & {"deg", "degrees"} for table in tables):
        what = f"Euler angles of at most {widest:.2f}, which may be radians in any order"
        raise WearcapError(what, path, "quaternions, or degrees as Unity and Unreal write them", "Log quaternions.")
    if not _unreal(tables[0].columns.form, axes):
        return [UNITY_ANGLES]
    head, *hands = [table.values[np.isfinite(table.values).all(1), :3] for _, table in sorted(rows.items())]
    below = [head.mean(0) - hand.mean(0) for hand in hands if len(hand)] if len(head) else []
    up = np.abs(np.mean(below, 0)) if below else -np.std(head, 0) if len(head) else np.zeros(3)
    if axes != "unreal" and up.argmax() != 2:
        what = f"pitch, yaw and roll where {'xyz'[up.argmax()]} seems to be up, as it is not in Unreal's axes"
        raise WearcapError(what, path, "axes of known angles", "Say whose they are: axes=unreal|unity.")
    return [UNREAL_ANGLES]


def _parts(table: DeviceRows, axes: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) and rotations, (n, 4) or (n, 3, 3); NaN in rows without numbers.

    Unity applies Euler angles about z, x and y in turn. Unreal's pitch and roll turn against its y and x axes.
    """
    values, form = table.values, table.columns.form
    values = np.where((np.abs(values) < 1e9).all(1, keepdims=True), values, np.nan)
    if form == "quaternion":
        return values[:, :3], values[:, 3:]
    if form == "matrix":
        matrices = values.reshape(len(values), -1, 4)
        if matrices.shape[1] == 4 and np.nanmax(np.abs(matrices[:, 3, :3]), initial=0.0) > 0:
            matrices = matrices.swapaxes(1, 2)  # by columns
            if np.nanmax(np.abs(matrices[:, 3, :3]), initial=0.0) > 0:
                raise WearcapError("matrices that are no rigid poses", path, "a last row or column of 0 0 0 1")
        return matrices[:, :3, 3], matrices[:, :3, :3]
    R = np.full((len(values), 3, 3), np.nan)
    whole = np.isfinite(values).all(1)
    first, second, third = values[whole, 3:].T
    turns, angles = "YXZ", (second, first, third)
    if _unreal(form, axes):
        pitch, yaw, roll = (first, second, third) if form == "rotator" else (second, third, first)
        turns, angles = "ZYX", (yaw, -pitch, -roll)
    if whole.any():
        R[whole] = Rotation.from_euler(turns, np.stack(angles, 1), degrees=True).as_matrix()
    return values[:, :3], R


def _seen(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rows with a pose: finite, and not the zeros that runtimes write for what they do not see."""
    turn = rotation.reshape(len(rotation), -1)
    finite = np.isfinite(position).all(1) & np.isfinite(turn).all(1)
    nothing = np.linalg.norm(turn, axis=1) < 0.5
    still = np.abs(turn).max(1) > 0.9999 if turn.shape[1] == 4 else (turn == np.eye(3).ravel()).all(1)
    return finite & ~nothing & ~((position == 0).all(1) & still)


def _check_rotations(rotation: np.ndarray, rows: np.ndarray, where: str, path: Path) -> None:
    """Raise WearcapError for the first quaternion far from unit norm, or matrix that is no rotation."""
    if rotation.ndim == 2:
        off, what = np.abs(np.linalg.norm(rotation, axis=1) - 1) > _TOLERANCE[0], "quaternion"
    else:
        skew = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max((1, 2))
        off, what = (skew > _TOLERANCE[1]) | (np.linalg.det(rotation) < 0), "matrix"
    if off.any():
        shown = rotation[off][0].round(4).tolist()
        fix = "Check that the columns are the rotation's."
        raise WearcapError(f"{where}{rows[off][0]}: the {what} {shown} is no rotation", path, "rotations", fix)


# --- tracking ------------------------------------------------------------------------------------------------------


def _tracked(pose: RawPoses, seen: np.ndarray, joint: str, poses: dict[str, RawPoses]) -> list[str]:
    """Mark in `seen` the rows (n,) in which a device is tracked: short gaps of the head are filled, and a hand's frozen
    poses are none. Notes."""
    notes, lost = [], int((~seen).sum())
    if lost:
        notes.append(f"{joint} is not tracked in {lost} of {len(seen)} rows")
    if seen.sum() < 2:
        return notes
    if joint == "head":
        if filled := _fill(pose, seen):
            notes.append(f"{filled} of them, in gaps of at most {FILLED_S:g} s, were interpolated")
    else:
        frozen = _frozen(pose, poses["head"]) & seen
        seen &= ~frozen
        if frozen.any():
            notes.append(f"{joint} repeats its last pose in {int(frozen.sum())} rows, where it counts as lost")
    return notes


def _frozen(hand: RawPoses, head: RawPoses) -> np.ndarray:
    """Rows (n,) that repeat a hand's pose of the row before, in runs over `FROZEN_S` in which the head moves."""
    numbers = np.concatenate([hand.position, hand.rotation.reshape(len(hand.rotation), -1)], 1)
    same = np.append(False, (np.diff(numbers, axis=0) == 0).all(1))
    starts = np.flatnonzero(~same)
    ends = np.append(starts[1:], len(same)) - 1
    first, last = (
        np.searchsorted(head.seconds, hand.seconds[at]).clip(max=len(head.seconds) - 1) for at in (starts, ends)
    )
    moved = (head.position[first] != head.position[last]).any(1)
    long = (hand.seconds[ends] - hand.seconds[starts] > FROZEN_S) & moved
    return same & long[np.cumsum(~same) - 1]


def _fill(pose: RawPoses, seen: np.ndarray) -> int:
    """Interpolate lost poses between neighbours that are close in time, and mark them as seen; how many."""
    known, lost = np.flatnonzero(seen), np.flatnonzero(~seen)
    lost = lost[(lost > known[0]) & (lost < known[-1])]
    after = np.searchsorted(known, lost)
    lost = lost[pose.seconds[known[after]] - pose.seconds[known[after - 1]] <= FILLED_S]
    if len(lost):
        at, times, quaternions = pose.seconds[lost], pose.seconds[known], pose.rotation.ndim == 2
        turns = (Rotation.from_quat if quaternions else Rotation.from_matrix)(pose.rotation[known])
        between = Slerp(times, turns)(at)  # the same arc in either order of the components
        pose.position[lost] = np.stack([np.interp(at, times, column) for column in pose.position[known].T], 1)
        pose.rotation[lost] = between.as_quat() if quaternions else between.as_matrix()
        seen[lost] = True
    return len(lost)


def _together(poses: dict[str, RawPoses], notes: list[str]) -> dict[str, RawPoses]:
    """Poses of the time in which all devices are tracked; a hand that leaves too little of it is left out. Notes are added."""
    begin, end = poses["head"].seconds[[0, -1]]
    spans = {}
    for joint, pose in poses.items():
        first, last = pose.seconds[[0, -1]] if len(pose.seconds) > 1 else (end, begin)
        spans[joint] = first if first - begin > LATE_S else begin, last if end - last > LATE_S else end
    while True:
        latest, earliest = max(spans, key=lambda joint: spans[joint][0]), min(spans, key=lambda joint: spans[joint][1])
        low, high = spans[latest][0], spans[earliest][1]
        if high - low >= _MOST * (end - begin):
            break
        worst = min(spans, key=lambda joint: spans[joint][1] - spans[joint][0])
        first, last = spans.pop(worst)
        notes.append(f"{worst} is left out: it is tracked over {max(last - first, 0):.1f} of {end - begin:.1f} s only")
    for which, cut, joint in (("first", low - begin, latest), ("last", end - high, earliest)):
        if cut > 0:
            notes.append(f"the {which} {cut:.1f} s are left out: {joint} is not tracked in them")
    return {
        joint: _of_rows(poses[joint], (poses[joint].seconds >= low) & (poses[joint].seconds <= high)) for joint in spans
    }
