"""Hand joints in headsets' logs: which columns are whose joint, and the joints' places.

A column's name names a side, a joint (OpenXR's or WebXR's, Unity's and Unreal's "IndexProximal", MRTK's "IndexKnuckle"), and
x, y, z, or the number of an array of 3, of 7 (a pose) or of 16 (a matrix). Rotations are not read.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from wearcap.body.hands import CHAINS, FINGER_NAMES, HAND_JOINTS, PALM
from wearcap.body.skeleton import SIDES

_SIDE_WORDS = {side: {side, side[0], f"{side}hand", f"{side[0]}hand"} for side in SIDES}
_FINGERS = {name: name for name in FINGER_NAMES} | {"little": "pinky"}
_BONES = {bone: bone for bone in ("metacarpal", "proximal", "intermediate", "distal", "tip")}
_BONES |= {"knuckle": "proximal", "middle": "intermediate"}
_NO_PLACE = {"rot", "rotation", "quat", "quaternion", "orientation", "q", "euler", "velocity", "vel", "radius"}
_COMPONENT = re.compile(r"(?:pos|position|p|m)?([xyz]|\d\d?)")
_NEEDED = {HAND_JOINTS[k] for k in (*PALM, *(chain[1] for chain in CHAINS))}


@dataclass(frozen=True)
class FingerColumns:
    """Columns of a hand's joints."""

    joints: tuple[str, ...]
    places: tuple[Any, ...]
    """Of each joint 3, or the 16 of a matrix."""

    def points(self, values: np.ndarray) -> np.ndarray:
        """(n, joint, 3) places of `HAND_JOINTS` from the numbers (n, k) of the columns; NaN where the hand is not tracked."""
        table = np.where(np.abs(values) < 1e9, values, np.nan).reshape(len(values), len(self.joints), -1)
        if table.shape[2] == 16:
            m = table.reshape(*table.shape[:2], 4, 4)
            by_columns = np.nanmax(np.abs(m[..., 3, :3]), initial=0.0) > 0
            table = m[..., 3, :3] if by_columns else m[..., :3, 3]
        points = np.full((len(values), len(HAND_JOINTS), 3), np.nan)
        points[:, [HAND_JOINTS.index(joint) for joint in self.joints]] = table
        points[(points[:, PALM] == 0).all((1, 2))] = np.nan  # what runtimes write for a hand that they do not see
        return points


def finger_columns(named: Iterable[tuple[list[str], Any]]) -> dict[str, FingerColumns]:
    """Columns of the hands by side, from the words of each column's name and its place; of hands with wrist and knuckles."""
    groups: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for parts, place in named:
        side = next((side for side, words in _SIDE_WORDS.items() if words & set(parts)), None)
        joint, behind = _joint(parts)
        if side and behind and not set(behind) & _NO_PLACE and (component := _COMPONENT.fullmatch(behind[-1])):
            group = groups.setdefault((side, joint), {}).setdefault(" ".join(behind[:-1]), {})
            group.setdefault(component[1], place)
    columns = {}
    for side in SIDES:
        found = {joint: places for joint in HAND_JOINTS if (places := _components(groups.get((side, joint), {})))}
        if set(found) >= _NEEDED and len({*map(len, found.values())}) == 1:
            columns[side] = FingerColumns(tuple(found), tuple(place for each in found.values() for place in each))
    return columns


def _joint(parts: list[str]) -> tuple[str, list[str]]:
    """The joint that words name, and the words behind it."""
    at = next((k for k, word in enumerate(parts) if word in _FINGERS), None)
    if at is None:
        return "wrist", parts[parts.index("wrist") + 1 :] if "wrist" in parts else []
    bone = next((k for k in range(at + 1, len(parts)) if parts[k] in _BONES), len(parts) - 1)
    return f"{_FINGERS[parts[at]]}_{_BONES.get(parts[bone], '')}", parts[bone + 1 :]


def _components(groups: dict[str, dict[str, Any]]) -> list[Any]:
    """Places of a joint's x, y, z, or of its matrix's 16 numbers; none for another array."""
    for group in groups.values():
        if {"x", "y", "z"} <= set(group):
            return [group[axis] for axis in "xyz"]
        if len(group) in (3, 7, 16) and set(group) == {*map(str, range(len(group)))}:
            return [group[str(k)] for k in range(16 if len(group) == 16 else 3)]
    return []
