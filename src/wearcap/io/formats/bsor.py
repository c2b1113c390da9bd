"""Beat Saber's replays (.bsor): the poses of head and sabers. Of the rest, players' names too, nothing is kept."""

import struct
from pathlib import Path

import numpy as np

from wearcap.boundary.opening import open_bytes, read_bytes
from wearcap.errors import WearcapError

_MAGIC = struct.pack("<IB", 0x442D3D69, 1)
_TEXTS = 13, 3
"""Texts of the block of information: before the score, and after it, of which the last names the modifiers."""
_NUMBERS = struct.Struct("<f?4f")
"""After them: the jump's distance, whether the player is left-handed, height, start, fail, and the song's speed or 0."""
_SPEEDS = {"SS": 0.85, "FS": 1.2, "SF": 1.5}
"""Of modifiers: slower, faster, and super fast song."""
_FRAME = np.dtype([("seconds", "<f4"), ("rate", "<i4"), ("poses", "<f4", (3, 7))])


def is_bsor(path: Path) -> bool:
    """Whether a file begins as a replay does. Raises WearcapError for one that cannot be opened."""
    with open_bytes(path) as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read_bsor(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) in s, and poses (n, 3, 7) of head, left and right saber in Unity's axes: position (m), quaternion xyzw.

    Times in the file are the song's, which runs faster or slower by its modifiers.
    Raises WearcapError for a file that is cut short or that is no replay.
    """
    content = read_bytes(path)
    if not content.startswith(_MAGIC):
        raise WearcapError("no replay of Beat Saber", path, "BSOR version 1")
    try:
        at, speed = _information(content, len(_MAGIC))
        block, count = struct.unpack_from("<Bi", content, at)
    except (struct.error, ValueError) as error:
        raise WearcapError("it is cut short before the first frame", path, "a whole replay") from error
    if block != 1 or count < 0:
        raise WearcapError(f"block {block} with {count} frames", path, "block 1, the frames")
    whole = (len(content) - at - 5) // _FRAME.itemsize
    if count > whole:
        raise WearcapError(f"{count} frames, of which {whole} are there", path, "a whole replay", "Fetch it again.")
    frames = np.frombuffer(content, _FRAME, count, at + 5)
    with np.errstate(invalid="ignore"):  # NaN is no pose
        return frames["seconds"] / speed, frames["poses"].astype(np.float64)


def _information(content: bytes, at: int) -> tuple[int, np.float64]:
    """Where the block of information ends, and the song's speed. Raises struct.error or ValueError where it is cut short."""
    if content[at : at + 1] != b"\0":
        raise ValueError
    at, text = at + 1, b""
    for texts, numbers in zip(_TEXTS, (4, _NUMBERS.size)):
        for _ in range(texts):
            (length,) = struct.unpack_from("<i", content, at)
            text, at = content[at + 4 : at + 4 + length], at + 4 + length
            if length < 0 or at > len(content):
                raise ValueError
        at += numbers
    practice = _NUMBERS.unpack_from(content, at - _NUMBERS.size)[-1]
    named = (speed for name, speed in _SPEEDS.items() if name in text.decode("latin-1").split(","))
    return at, np.float64(practice if 0.1 < practice < 10 else next(named, 1.0))
