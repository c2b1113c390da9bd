"""Handlings: motions of objects over time, and which hands held them when."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.interactions import HANDS, Interactions
from wearcap.recording.motion import Motion
from wearcap.simulation.handling.grips import Grip, Moves

Row = tuple[float, float, tuple[bool, bool]]
"""Interval (s) with a fixed set of holding hands, one flag for each of `HANDS`."""


@dataclass(frozen=True)
class Handling:
    """One object's handling from the first touch to the last release, and its motion meanwhile."""

    name: str
    contact_class: str
    moves: Moves
    start_s: float
    stop_s: float
    rows: tuple[Row, ...]


def handling_of(name: str, contact_class: str, moves: Moves, grips: Sequence[tuple[str, Grip]]) -> Handling:
    """A handling from its grips (side, grip): rows are split where the set of holding hands changes."""
    rows = hand_rows([(side, grip.touch_s, grip.release_s) for side, grip in grips])
    return Handling(name, contact_class, moves, rows[0][0], rows[-1][1], tuple(rows))


def hand_rows(held: Iterable[tuple[str, float, float]]) -> list[Row]:
    """Intervals with a fixed set of holding hands, from (side, start, stop) in s; a hand may hold several times."""
    held = list(held)
    edges = sorted({time for _, start, stop in held for time in (start, stop)})
    rows = []
    for start, stop in pairwise(edges):
        middle = (start + stop) / 2
        hands = {side for side, first, last in held if first <= middle < last}
        if hands:
            rows.append((start, stop, ("left" in hands, "right" in hands)))
    return rows


def interactions_of(handlings: Sequence[Handling]) -> Interactions:
    """All rows, ordered by their start."""
    rows = sorted(((row, handling) for handling in handlings for row in handling.rows), key=lambda pair: pair[0][:2])
    return Interactions(
        torch.tensor([row[0] for row, _ in rows], dtype=torch.float64),
        torch.tensor([row[1] for row, _ in rows], dtype=torch.float64),
        torch.tensor([row[2] for row, _ in rows], dtype=torch.bool).reshape(-1, len(HANDS)),
        tuple(handling.name for _, handling in rows),
        tuple(handling.contact_class for _, handling in rows),
    )


def object_motion(T_world_object: Rigid, handlings: Sequence[Handling], motion: Motion) -> Trajectory:
    """Poses of an object on a motion's timestamps: as its handlings move it, static between them.

    `handlings` are those of this one object; `T_world_object` is its initial pose; `motion` is the wearer's, whose
    chest carried objects follow.
    """
    times, chest = motion.timestamps.numpy(), motion.joint("t8").to(torch.float64)
    R = T_world_object.R.double().repeat(len(times), 1, 1)
    t = T_world_object.t.double().repeat(len(times), 1)
    for handling in sorted(handlings, key=lambda handling: handling.start_s):
        first, last = np.searchsorted(times, (handling.start_s, handling.stop_s)).tolist()
        if first >= len(times):
            continue
        last = max(last, first + 1)
        pose = handling.moves(times[first:last], chest[first:last])
        R[first:last], t[first:last] = pose.R, pose.t
        R[last:], t[last:] = pose.R[-1], pose.t[-1]
    return Trajectory(motion.timestamps, R.float(), t.float())
