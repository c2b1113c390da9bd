"""From rows to poses: which clock counts, which rows are poses, and what of a recording all devices are tracked in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from wearcap.errors import WearcapError
from wearcap.io.devices.headset_tables import DeviceRows, RawPoses, parts_of
from wearcap.io.devices.headset_times import grain, in_seconds, rising
from wearcap.io.formats.trajectory import check_span

_KINDS = {"wrist": {"wrist"}, "grip": {"grip", "controller", "ctrl", "leftcontroller", "rightcontroller", "saber"}}
_ORDERS = ("xyzw", "wxyz")
MAX_FILLED_S = 1.0
"""Longest gap in the head's tracking that is interpolated."""
LATE_S = 0.5
"""How much later a hand may be tracked than the head, or be lost before it."""
FROZEN_S = 0.5
"""How long a hand keeps a pose to the last digit, while the head moves, without being lost."""
_MOST = 0.5
"""Least share of a recording that remains when it is cut to where a hand is tracked."""
_NORM, _SKEW = 0.02, 0.1
"""Largest deviations from rotations: of a quaternion's norm from 1, and of a matrix times its transpose."""


def raw_poses(rows: dict[str, DeviceRows], time_unit: str | None, path: Path) -> tuple[dict[str, RawPoses], list[str]]:
    """Poses of the devices over the time in which all of them are tracked, and notes of what was mended.

    Raises WearcapError for times that are none, for a head without two poses, and for rotations that are none.
    """
    clock = _clock(rows, time_unit, path)
    notes, poses = [f"times {_seconds(rows['head'], clock, time_unit, path)[1]} ({clock})"], {}
    degrees, shared = _in_degrees(rows, path), (np.zeros(0), np.zeros(0, np.int64))
    for joint, table in sorted(rows.items()):  # the head first
        position, rotation = _parts(table, degrees, path)
        seen = _seen(position, rotation)
        if joint == "head" or not np.array_equal(table.clocks[clock], rows["head"].clocks[clock], equal_nan=True):
            timed = _seconds(table, clock, time_unit, path)[0]
            seconds, kept, mended = rising(
                timed, np.where(seen[:, None], position, np.nan), table.rows, table.where, path
            )
            notes += [f"{joint}: {mended}"] if mended else []
            shared = (seconds, kept) if joint == "head" else shared
        else:
            seconds, kept = shared
        _check_rotations(rotation[kept][seen[kept]], table.rows[kept][seen[kept]], f"{table.where} ", path)
        order, kind = _named(table)
        poses[joint], said = _tracked(
            RawPoses(seconds, position[kept], rotation[kept], order, kind), seen[kept], joint, poses
        )
        notes += said
    if len(poses["head"].seconds) < 2:
        raise WearcapError("no two tracked poses of the headset", path, "positions and rotations")
    check_span(poses["head"].seconds, path, lambda row: f"pose {row + 1} of the head")
    trimmed, said = _together(poses)
    return trimmed, notes + said


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


def _named(table: DeviceRows) -> tuple[str | None, str | None]:
    """Order of the quaternions, and what a hand's pose is of, where names say so."""
    words, columns = table.columns.words, table.columns
    order = None
    if columns.form == "quaternion":
        order = "xyzw" if "x" in columns.rotation else next((order for order in _ORDERS if order in words), None)
    return order, next((kind for kind, known in _KINDS.items() if words & known), None)


def _in_degrees(rows: dict[str, DeviceRows], path: Path) -> bool:
    """Whether there are Euler angles, which are taken in degrees. Raises WearcapError where they may be radians."""
    angles = [table.values[:, 3:] for table in rows.values() if table.columns.form in ("euler", "rotator")]
    if not angles:
        return False
    widest = max(float(np.nanmax(np.abs(values), initial=0.0)) for values in angles)
    if widest <= 2 * np.pi and not any(table.columns.words & {"deg", "degrees"} for table in rows.values()):
        what = f"Euler angles of at most {widest:.2f}, which may be radians in any order"
        raise WearcapError(what, path, "quaternions, or degrees as Unity and Unreal write them", "Log quaternions.")
    return True


def _parts(table: DeviceRows, degrees: bool, path: Path) -> tuple[np.ndarray, np.ndarray]:
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
    turns = ("YXZ", (second, first, third)) if form == "euler" else ("ZYX", (second, -first, -third))
    if whole.any():
        R[whole] = Rotation.from_euler(turns[0], np.stack(turns[1], 1), degrees=degrees).as_matrix()
    return values[:, :3], R


def _seen(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rows with a pose: finite, and not the zeros that runtimes write for what they do not see."""
    turn = rotation.reshape(len(rotation), -1)
    finite = np.isfinite(position).all(1) & np.isfinite(turn).all(1)
    nothing = np.linalg.norm(turn, axis=1) < 0.5
    still = np.abs(turn).max(1) == 1 if turn.shape[1] == 4 else (turn == np.eye(3).ravel()).all(1)
    return finite & ~nothing & ~((position == 0).all(1) & still)


def _check_rotations(rotation: np.ndarray, rows: np.ndarray, where: str, path: Path) -> None:
    """Raise WearcapError for the first quaternion far from unit norm, or matrix that is no rotation."""
    if rotation.ndim == 2:
        off, what, expected = np.abs(np.linalg.norm(rotation, axis=1) - 1) / _NORM, "quaternion", "of norm 1"
    else:
        skew = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max((1, 2))
        off = np.where(np.linalg.det(rotation) < 0, np.inf, skew / _SKEW)
        what, expected = "matrix", "orthogonal within 5 %, and no mirror"
    if (off > 1).any():
        worst = int((off > 1).argmax())
        shown = np.round(rotation[worst], 4).tolist()
        fix = "Check that the columns are the rotation's."
        raise WearcapError(f"{where}{rows[worst]}: the {what} {shown} is no rotation", path, expected, fix)


# --- tracking ------------------------------------------------------------------------------------------------------


def _tracked(pose: RawPoses, seen: np.ndarray, joint: str, poses: dict[str, RawPoses]) -> tuple[RawPoses, list[str]]:
    """Poses where a device is tracked: short gaps of the head are filled, frozen poses of a hand are none; and notes."""
    notes = []
    if lost := int((~seen).sum()):
        notes.append(f"{joint} is not tracked in {lost} of {len(seen)} rows")
    kept = seen
    if joint != "head" and seen.sum() > 1:
        frozen = _frozen(pose, poses["head"]) & seen
        if frozen.any():
            notes.append(f"{joint} repeats its last pose in {int(frozen.sum())} rows, where it counts as lost")
        kept = seen & ~frozen
    elif joint == "head" and lost and seen.sum() > 1:
        pose, kept = _filled(pose, seen)
        if filled := int(kept.sum() - seen.sum()):
            notes.append(f"{filled} of them, in gaps of at most {MAX_FILLED_S:g} s, were interpolated")
    return replace(pose, seconds=pose.seconds[kept], position=pose.position[kept], rotation=pose.rotation[kept]), notes


def _frozen(hand: RawPoses, head: RawPoses) -> np.ndarray:
    """Rows that repeat a hand's pose of the row before, in runs over `FROZEN_S` in which the head moves."""
    turn = hand.rotation.reshape(len(hand.rotation), -1)
    same = np.append(False, (np.diff(hand.position, axis=0) == 0).all(1) & (np.diff(turn, axis=0) == 0).all(1))
    run = np.cumsum(~same) - 1
    starts = np.flatnonzero(~same)
    ends = np.append(starts[1:], len(same)) - 1
    near = [np.searchsorted(head.seconds, hand.seconds[at]).clip(max=len(head.seconds) - 1) for at in (starts, ends)]
    moved = np.abs(head.position[near[0]] - head.position[near[1]]).max(1) > 0
    long = (hand.seconds[ends] - hand.seconds[starts] > FROZEN_S) & moved
    return same & long[run]


def _filled(pose: RawPoses, seen: np.ndarray) -> tuple[RawPoses, np.ndarray]:
    """Poses with lost ones between close neighbours interpolated, and which rows are poses now."""
    rows, known = np.arange(len(seen)), np.flatnonzero(seen)
    after = np.searchsorted(known, rows).clip(max=len(known) - 1)
    before = (np.searchsorted(known, rows, side="right") - 1).clip(0)
    gap = pose.seconds[known[after]] - pose.seconds[known[before]]
    inside = (rows > known[0]) & (rows < known[-1]) & (gap <= MAX_FILLED_S)
    numbers = np.concatenate([pose.position, pose.rotation.reshape(len(seen), -1)], 1)[known]
    if pose.rotation.ndim == 2:
        signs = np.sign((numbers[1:, 3:] * numbers[:-1, 3:]).sum(1))
        numbers[1:, 3:] *= np.cumprod(np.where(signs < 0, -1.0, 1.0))[:, None]
    between = np.stack([np.interp(pose.seconds, pose.seconds[known], column) for column in numbers.T], 1)
    turn = between[:, 3:].reshape(pose.rotation.shape)
    if turn.ndim == 3:
        U, _, V = np.linalg.svd(turn)
        turn = U @ V
    else:
        turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    fill = inside & ~seen
    position = np.where(fill[:, None], between[:, :3], pose.position)
    rotation = np.where(fill.reshape(-1, *[1] * (turn.ndim - 1)), turn, pose.rotation)
    return replace(pose, position=position, rotation=rotation), seen | inside


def _together(poses: dict[str, RawPoses]) -> tuple[dict[str, RawPoses], list[str]]:
    """Poses of the time in which all devices are tracked; a hand that leaves too little of it is left out. And notes."""
    notes, head = [], poses["head"].seconds
    kept = {joint: pose for joint, pose in poses.items() if joint == "head" or len(pose.seconds) > 1}
    notes += [f"{joint} is never tracked" for joint in poses if joint not in kept]

    def span(joint: str) -> tuple[float, float]:
        first, last = kept[joint].seconds[[0, -1]]
        late, early = first - head[0] > LATE_S, head[-1] - last > LATE_S
        return (float(first) if late else float(head[0])), (float(last) if early else float(head[-1]))

    while True:
        spans = {joint: span(joint) for joint in kept}
        low, high = max(one[0] for one in spans.values()), min(one[1] for one in spans.values())
        if high - low >= _MOST * (head[-1] - head[0]):
            break
        worst = min(spans, key=lambda joint: spans[joint][1] - spans[joint][0])
        first, last = spans[worst]
        notes.append(f"{worst} is tracked from {first - head[0]:.1f} to {last - head[0]:.1f} s only, and left out")
        kept.pop(worst)
    for cut, which, joint in (
        (low - head[0], "first", max(spans, key=lambda joint: spans[joint][0])),
        (head[-1] - high, "last", min(spans, key=lambda joint: spans[joint][1])),
    ):
        if cut > 0:
            notes.append(f"the {which} {cut:.1f} s are left out: {joint} is not tracked in them")
    inside = {joint: (pose.seconds >= low) & (pose.seconds <= high) for joint, pose in kept.items()}
    return {
        joint: replace(
            pose, **{name: getattr(pose, name)[inside[joint]] for name in ("seconds", "position", "rotation")}
        )
        for joint, pose in kept.items()
    }, notes
