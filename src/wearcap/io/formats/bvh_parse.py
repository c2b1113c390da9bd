"""Parser of a BVH file's HIERARCHY and MOTION parts, in the file's own units, axes and channel order."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.io.formats.text import at_line, finite_floats, is_finite_number

CHANNELS = {f"{axis}{kind}": (kind[0], axis) for axis in "xyz" for kind in ("position", "rotation")}
MAX_JOINTS = 2000
_MAX_WORDS = 64
"""Most words of a joint's name."""
_END_SITE = -1
"""Index that marks an End Site among the open blocks."""


@dataclass
class BvhJoint:
    """One joint of the file; offsets in file units."""

    name: str
    parent: int
    line: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[tuple[str, str]] = field(default_factory=list)
    """("p" or "r", axis) in the file's order."""
    end: list[float] | None = None


def parse_hierarchy(path: Path, lines: Iterator[tuple[int, str]]) -> tuple[list[BvhJoint], int]:
    """Joints with parents first, and the number of the MOTION line, up to which the lines are consumed."""
    words = _Words(lines)
    joints: list[BvhJoint] = []
    blocks: list[int] = []
    line = 1
    try:
        for word in words:
            key, line = word.upper(), words.line
            if key in ("ROOT", "JOINT", "END"):
                blocks.append(_begin(joints, blocks, key, words.name(), line))
            elif key == "OFFSET":
                _place(joints, blocks, finite_floats(islice(words, 3)).tolist())
            elif key == "CHANNELS":
                count = int(next(words))
                if not 0 <= count <= len(CHANNELS):
                    raise ValueError(f"CHANNELS {count}")
                _add_channels(joints, blocks, count, [name.lower() for name in islice(words, count)])
            elif key == "}":
                blocks.pop()
            elif key != "HIERARCHY":
                raise ValueError(f"unknown word {word[:30]!r}")
    except (ValueError, IndexError, StopIteration) as error:
        raise WearcapError(
            f"the hierarchy is broken here ({str(error) or 'it ends too early'})"[:200],
            where=at_line(path, line),
            expected="BVH",
        ) from error
    if not joints or blocks or not words.motion_line:
        raise WearcapError(
            "no complete HIERARCHY followed by MOTION",
            where=at_line(path, words.line),
            expected="a whole BVH file",
            fix="Fetch it again.",
        )
    if len({joint.name for joint in joints}) < len(joints):
        raise WearcapError("two joints share a name", where=path, expected="unique joint names")
    return joints, words.motion_line


class _Words:
    """The words of a hierarchy one after another, until the line MOTION; `line` is the number of the last one's line."""

    def __init__(self, lines: Iterator[tuple[int, str]]):
        self.line, self.motion_line = 1, 0
        self._words = self._split(lines)

    def _split(self, lines: Iterator[tuple[int, str]]) -> Iterator[str]:
        for number, line in lines:
            self.line = number
            if line.strip().upper() == "MOTION":
                self.motion_line = number
                return
            yield from line.replace("{", " { ").replace("}", " } ").split()

    def name(self) -> str:
        """The words until a block opens."""
        words: list[str] = []
        while (word := next(self)) != "{":
            if len(words) == _MAX_WORDS:
                raise ValueError("a name without an end")
            words.append(word)
        return " ".join(words)

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        return next(self._words)


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


def parse_motion(
    path: Path, lines: Iterator[tuple[int, str]], motion_line: int, channels: int
) -> tuple[float, np.ndarray]:
    """Time step (s) and values "time channel"."""
    lines = ((number, line) for number, line in lines if line.strip())
    try:
        (_, first), (line, second) = next(lines), next(lines)
        count = int(first.lower().split("frames:")[1])
        step_s = float(second.lower().split("frame time:")[1])
    except (ValueError, IndexError, StopIteration) as error:
        raise WearcapError("no 'Frames:' and 'Frame Time:' below MOTION", where=at_line(path, motion_line)) from error
    if not 1e-5 <= step_s <= 10:
        raise WearcapError(f"frame time {step_s} s", where=at_line(path, line), expected="seconds per frame, above 0")
    values, odd, rows = array("d"), None, 0
    for number, text in lines:
        words = text.split()
        rows += 1
        try:
            values.extend(finite_floats(words))
        except ValueError as error:
            bad = next(word for word in words if not is_finite_number(word))
            raise WearcapError(f"{bad[:30]!r} is no finite number", where=at_line(path, number)) from error
        if len(words) != channels and odd is None:
            odd = WearcapError(
                f"{len(words)} values",
                where=at_line(path, number),
                expected=f"{channels}, one per channel of the hierarchy",
            )
        if len(values) > count * channels:
            break
    if len(values) != count * channels or not values:
        raise odd or WearcapError(
            f"{rows} frames", where=path, expected=f"{count} frames, as in the file's header (at least one)"
        )
    return step_s, np.asarray(values).reshape(count, channels)
