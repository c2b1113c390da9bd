"""The two halves of a BVH file, HIERARCHY and MOTION, as they stand: the file's units, axes and channel order."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.io.text import at_line, finite_floats, is_finite_number

CHANNELS = {f"{axis}{kind}": (kind[0], axis) for axis in "xyz" for kind in ("position", "rotation")}
MAX_JOINTS = 2000
_END_SITE = -1
"""Stands for an End Site among the open blocks."""


@dataclass
class BvhJoint:
    """One joint as the file has it; offsets in file units."""

    name: str
    parent: int
    line: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[tuple[str, str]] = field(default_factory=list)
    """("p" or "r", axis) in the file's order."""
    end: list[float] | None = None


def parse_hierarchy(path: Path, lines: list[str]) -> tuple[list[BvhJoint], int]:
    """Joints with parents first, and the index of the MOTION line."""
    motion_line = next((i for i, line in enumerate(lines) if line.strip().upper() == "MOTION"), len(lines))
    tokens = [(word, number) for number, line in enumerate(lines[:motion_line], 1)
              for word in line.replace("{", " { ").replace("}", " } ").split()]  # fmt: skip
    joints: list[BvhJoint] = []
    blocks: list[int] = []
    i, line = 0, 1
    try:
        while i < len(tokens):
            word, line = tokens[i]
            key, i = word.upper(), i + 1
            if key in ("ROOT", "JOINT", "END"):
                brace = next(k for k in range(i, len(tokens)) if tokens[k][0] == "{")
                name = " ".join(token for token, _ in tokens[i:brace])
                blocks.append(_begin(joints, blocks, key, name, line))
                i = brace + 1
            elif key == "OFFSET":
                offset = finite_floats(token for token, _ in tokens[i : i + 3]).tolist()
                _place(joints, blocks, offset)
                i += 3
            elif key == "CHANNELS":
                count = int(tokens[i][0])
                names = [token.lower() for token, _ in tokens[i + 1 : i + 1 + count]]
                _add_channels(joints, blocks, count, names)
                i += 1 + count
            elif key == "}":
                blocks.pop()
            elif key != "HIERARCHY":
                raise ValueError(f"unknown word {word[:30]!r}")
    except (ValueError, IndexError, StopIteration) as error:
        raise WearcapError(f"the hierarchy is broken here ({str(error) or 'it ends too early'})",
                           where=at_line(path, line), expected="BVH") from error  # fmt: skip
    if not joints or blocks or motion_line == len(lines):
        raise WearcapError("no complete HIERARCHY followed by MOTION", where=at_line(path, max(motion_line, 1)),
                           expected="a whole BVH file", fix="Fetch it again.")  # fmt: skip
    if len({joint.name for joint in joints}) < len(joints):
        raise WearcapError("two joints share a name", where=path, expected="unique joint names")
    return joints, motion_line


def _begin(joints: list[BvhJoint], blocks: list[int], key: str, name: str, line: int) -> int:
    """Open a ROOT, JOINT or End Site block; returns the joint's index."""
    if (key == "ROOT") != (not blocks) or (key == "ROOT" and joints):
        raise ValueError(f"{key} {name[:30]!r} stands in the wrong place; one ROOT holds everything")
    if blocks and blocks[-1] == _END_SITE:
        raise ValueError("an End Site holds another joint")
    if key == "END":
        return _END_SITE
    if not name or len(joints) >= MAX_JOINTS:
        raise ValueError("a joint without a name" if not name else f"more than {MAX_JOINTS} joints")
    joints.append(BvhJoint(name, blocks[-1] if blocks else -1, line))
    return len(joints) - 1


def _place(joints: list[BvhJoint], blocks: list[int], offset: list[float]) -> None:
    if len(offset) != 3 or not blocks:
        raise ValueError("OFFSET needs three numbers inside a joint")
    if blocks[-1] != _END_SITE:
        joints[blocks[-1]].offset = offset
    elif joints[blocks[-2]].end is None:
        joints[blocks[-2]].end = offset


def _add_channels(joints: list[BvhJoint], blocks: list[int], count: int, names: list[str]) -> None:
    if not blocks or blocks[-1] == _END_SITE or joints[blocks[-1]].channels:
        raise ValueError("CHANNELS belongs once into a joint")
    if count < 0 or len(names) != count or not set(names) <= set(CHANNELS) or len(set(names)) != count:
        raise ValueError(f"CHANNELS {count} with {' '.join(names)[:80]}")
    joints[blocks[-1]].channels = [CHANNELS[name] for name in names]


def parse_motion(path: Path, lines: list[str], start: int, channels: int) -> tuple[float, np.ndarray]:
    """Time step (s) and values "time channel"."""
    content = [(number, line) for number, line in enumerate(lines[start + 1 :], start + 2) if line.strip()]
    try:
        (line, first), (line, second) = content[:2]
        count = int(first.lower().split("frames:")[1])
        step_s = float(second.lower().split("frame time:")[1])
    except (ValueError, IndexError) as error:
        raise WearcapError(
            "no 'Frames:' and 'Frame Time:' below MOTION", where=at_line(path, start + 1)
        ) from error
    if not 1e-5 <= step_s <= 10:
        raise WearcapError(
            f"frame time {step_s} s", where=at_line(path, line), expected="seconds per frame, above 0"
        )
    try:
        values = finite_floats(" ".join(text for _, text in content[2:]).split())
        if len(values) != count * channels or count < 1:
            raise ValueError("wrong number of values")
    except ValueError as error:
        raise _explained(path, content[2:], count, channels) from error
    return step_s, values.reshape(count, channels)


def _explained(path: Path, rows: list[tuple[int, str]], count: int, channels: int) -> WearcapError:
    """Find the first line of the motion that is wrong."""
    for number, text in rows:
        words = text.split()
        if bad := [word for word in words if not is_finite_number(word)]:
            return WearcapError(f"{bad[0][:30]!r} is no finite number", where=at_line(path, number))
        if len(words) != channels:
            return WearcapError(f"{len(words)} values", where=at_line(path, number),
                                expected=f"{channels}, one per channel of the hierarchy")  # fmt: skip
    return WearcapError(
        f"{len(rows)} frames", where=path, expected=f"{count} frames, as the file says (at least one)"
    )
