"""Hand joints in headsets' logs: which columns are whose joint, and the joints' places.

A column's name names a side, a joint (OpenXR's or WebXR's, Unity's and Unreal's "IndexProximal", MRTK's "IndexKnuckle", Meta's
"Hand_Index1"), and x, y, z, or the number of an array of 3, of 7 (a pose) or of 16 (a matrix). Rotations are not read.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wearcap.body.hands import CHAINS, FINGER_NAMES, HAND_JOINTS, PALM
from wearcap.body.skeleton import SIDES
from wearcap.recording.recording import FingerStream

_SIDE_WORDS = {side: {side, side[0], f"{side}hand", f"{side[0]}hand"} for side in SIDES}
_FINGERS = {name: name for name in FINGER_NAMES} | {"little": "pinky"}
_BONES = {"knuckle": "proximal", "middle": "intermediate"} | {
    bone: bone for bone in ("metacarpal", "proximal", "intermediate", "distal", "tip")
}
_NUMBERS = {"0": "metacarpal", "1": "proximal", "2": "intermediate", "3": "distal"}
_THUMB_NUMBERS = {"1": "metacarpal", "2": "proximal", "3": "distal"}
"""Meta's numbers of joints; the thumb's first, 0, lies in the wrist."""
_NO_PLACE = {"rot", "rotation", "quat", "quaternion", "orientation", "q", "euler", "velocity", "vel", "angular", "radius"}
_SIZES = (3, 7, 16)
_COMPONENT = re.compile(r"(?:pos|position|p|m)([xyz]|\d\d?)")


@dataclass(frozen=True)
class FingerColumns:
    """Columns of a hand's joints."""

    joints: tuple[str, ...]
    width: int
    """Numbers of each joint: 3, or 16 of a matrix."""
    places: tuple[Any, ...]


@dataclass(frozen=True)
class RawFingers:
    """A hand's joints as they stand in a file."""

    seconds: np.ndarray
    points: np.ndarray
    """(n, joint, 3) in the file's unit and axes; NaN where the hand or a joint is not tracked."""


def finger_columns(named: Iterable[tuple[list[str], Any]]) -> dict[str, FingerColumns]:
    """Columns of the hands by side, from the words of each column's name and its place; none without wrist and knuckles."""
    groups: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for parts, place in named:
        side = next((side for side, words in _SIDE_WORDS.items() if words & set(parts)), None)
        joint, behind = _joint(parts)
        if side is None or joint is None or not behind or set(behind) & _NO_PLACE:
            continue
        glued = _COMPONENT.fullmatch(behind[-1])
        group = groups.setdefault((side, joint), {}).setdefault(" ".join(behind[:-1]), {})
        group.setdefault(glued[1] if glued else behind[-1], place)
    columns = {}
    for side in SIDES:
        found = {joint: places for joint in HAND_JOINTS if (places := _components(groups.get((side, joint), {})))}
        width = max(map(len, found.values()), default=0)
        if {HAND_JOINTS[k] for k in (*PALM, *(chain[1] for chain in CHAINS))} <= set(found):
            kept = {joint: places for joint, places in found.items() if len(places) == width}
            columns[side] = FingerColumns(tuple(kept), width, tuple(place for each in kept.values() for place in each))
    return columns


def _joint(parts: list[str]) -> tuple[str | None, list[str]]:
    """The joint that words name, and the words behind it."""
    at = next((k for k, word in enumerate(parts) if word in _FINGERS), None)
    if at is None:
        return ("wrist", parts[parts.index("wrist") + 1 :]) if "wrist" in parts else (None, [])
    finger, behind = _FINGERS[parts[at]], parts[at + 1 :]
    bone = next((k for k, word in enumerate(behind) if word in _BONES), None)
    if bone is not None:
        joint, behind = f"{finger}_{_BONES[behind[bone]]}", behind[bone + 1 :]
    else:
        numbers = _THUMB_NUMBERS if finger == "thumb" else _NUMBERS
        joint, behind = f"{finger}_{numbers.get(behind[0], '') if len(behind) > 1 else ''}", behind[1:]
    return (joint, behind) if joint in HAND_JOINTS else (None, [])


def _components(groups: dict[str, dict[str, Any]]) -> list[Any]:
    """Places of a joint's x, y, z, or of its matrix's 16 numbers; none for another array."""
    for group in groups.values():
        if {"x", "y", "z"} <= set(group):
            return [group[axis] for axis in "xyz"]
        numbers = [str(k) for k in range(len(group))]
        if len(group) in _SIZES and set(group) == set(numbers):
            return [group[k] for k in (numbers if len(group) == 16 else numbers[:3])]
    return []


def finger_points(columns: FingerColumns, values: np.ndarray) -> np.ndarray:
    """(n, joint, 3) places of the 25 joints from the numbers of the columns (n, k)."""
    table = np.where(np.abs(values) < 1e9, values, np.nan).reshape(len(values), len(columns.joints), columns.width)
    if columns.width == 16:
        m = table.reshape(*table.shape[:2], 4, 4)
        by_columns = np.nanmax(np.abs(m[..., 3, :3]), initial=0.0) > 0
        table = m[..., 3, :3] if by_columns else m[..., :3, 3]
    points = np.full((len(values), len(HAND_JOINTS), 3), np.nan)
    points[:, [HAND_JOINTS.index(joint) for joint in columns.joints]] = table
    nowhere = (points[:, PALM] == 0).all((1, 2))  # what runtimes write for a hand that they do not see
    points[nowhere] = np.nan
    return points


def finger_stream(raw: RawFingers, axes: np.ndarray, unit_m: float) -> FingerStream:
    """A hand in metres and right-handed axes, by the rotation or reflection of the file's axes into ours."""
    points = torch.from_numpy(unit_m * raw.points @ axes.T).float()
    valid = points[:, PALM, :].isfinite().all(-1).all(-1)
    return FingerStream(torch.from_numpy(raw.seconds), points, valid, valid.float())
