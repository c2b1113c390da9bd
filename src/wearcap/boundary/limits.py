"""What anything from outside may take, by its kind: the only limits of size, number and depth that readers have.

A compressed file of kilobytes may unpack to more than all memory. Bytes read are counted against the limit of the kind
and, beyond `FREE_BYTES`, of the ratio to the packed bytes. `wearcap --max-file-gib N` (for worker processes the
environment variable `WEARCAP_MAX_FILE_GIB`) replaces both.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

from wearcap.errors import WearcapError

VARIABLE = "WEARCAP_MAX_FILE_GIB"
FREE_BYTES = 1 << 25
"""Unpacked bytes up to which their ratio to the packed ones does not matter (32 MiB)."""
MAX_RATIO = 100
"""Largest ratio of unpacked to packed bytes: text captures reach 5 to 30, decompression bombs a thousand and more."""
BYTES_PER_ITEM = 8
"""A kind's number of items grows by one for so many bytes: a list takes 72 bytes of memory however little it holds."""


@dataclass(frozen=True)
class Limits:
    """Limits of one kind of content."""

    bytes: int = 1 << 32
    """Of a file once unpacked, or of a message."""
    items: int = 1 << 20
    """Of parts that take memory of their own: lists, elements, joints, columns, pixels of a picture, arrays."""
    depth: int = 64
    """Levels of lists within lists."""
    line: int = 1 << 24
    """Characters of a line: COLMAP lists all points of a picture in one."""


LIMITS = {
    "file": Limits(),
    "text": Limits(bytes=1 << 29),  # over an hour of motion at 120 Hz
    "lines": Limits(),
    "table": Limits(bytes=1 << 31, line=1 << 16),  # two hours of poses at 1 kHz
    "streamed table": Limits(bytes=1 << 36, line=1 << 16),  # read in pieces
    "log": Limits(items=2000),  # columns
    "json": Limits(bytes=1 << 28),
    "config": Limits(bytes=1 << 20, items=10_000),  # of a checkpoint's model; a training run's has 10 kB
    "yaml": Limits(bytes=1 << 16, items=10_000),  # a page of settings
    "message": Limits(bytes=1 << 24, items=20_100),  # of a page or a device: 20,000 points, and what goes with them
    "mvnx": Limits(bytes=1 << 34, items=100_000, line=1 << 26),  # elements beside the frames, and bytes of one
    "video": Limits(bytes=1 << 40, items=1 << 26),  # pixels of a picture: 8192 x 8192
    "video tables": Limits(bytes=1 << 28),  # of an MP4: all but its pictures and sound
    "sound": Limits(bytes=1 << 31),  # three hours at 48 kHz
    "mesh": Limits(bytes=1 << 31, items=1 << 21),  # lists of a .glb, its vertices and corners
    "environment": Limits(bytes=1 << 24, items=10_000),  # objects
    "lens": Limits(bytes=1 << 24),
    "c3d": Limits(bytes=1 << 30),  # an hour of 100 markers at 300 Hz, or of force plates at 10 kHz
    "bvh": Limits(items=2000),  # joints
    "asf": Limits(items=2000),  # bones
    "colmap": Limits(bytes=1 << 34),
    "header": Limits(
        bytes=1 << 16, items=1 << 12
    ),  # of PLY and PCD; numbers of a field, of which PCL's longest has some 2000
    "arrays": Limits(items=1 << 14),
    "pickle": Limits(bytes=1 << 33),
    "weights": Limits(bytes=1 << 36),  # of PyTorch; items: bytes of the pickle that describes the tensors
    "tensors": Limits(bytes=1 << 25, items=1 << 16),  # the header of a .safetensors file, and its tensors
}
"""Limits by kind."""


class Budget:
    """What may still be read from one file or message of a kind."""

    def __init__(self, path: str | Path, kind: str = "file", packed: float = math.inf):
        """`packed` is the file's size in bytes; what is not packed has no limit of its ratio."""
        lifted = os.environ.get(VARIABLE, "").strip()
        self.path, self.limits, self.spent = path, LIMITS[kind], 0
        self.max_bytes = gib_bytes(lifted, VARIABLE) if lifted else self.limits.bytes
        self._by_ratio = math.inf if lifted else max(FREE_BYTES, MAX_RATIO * packed)

    def spend(self, size: int) -> None:
        """Count bytes before or after they are unpacked. Raises WearcapError beyond the limit."""
        self.spent += size
        if self.spent > self.max_bytes:
            what = f"larger than {_size(self.max_bytes)} once unpacked"
            raise WearcapError(what, self.path, "a smaller file", _lift(self.spent))
        if self.spent > self._by_ratio:
            what = f"it unpacks to more than {MAX_RATIO} times its size"
            raise WearcapError(what, self.path, "a capture, which packs 5 to 30 times", _lift(self.spent))

    def count(self, items: int, what: str) -> None:
        """Check a number of parts, which `what` names ("joints"). Raises WearcapError beyond the limit."""
        most = self.limits.items + self.spent // BYTES_PER_ITEM
        if items > most:
            raise WearcapError(f"more than {most} {what}", self.path, f"at most {most}")


def gib_bytes(text: str, where: str) -> int:
    """Bytes of a number of GiB. Raises WearcapError naming `where` it was given when it is no positive number."""
    try:
        gib = float(text)
    except ValueError:
        gib = math.nan
    if not 0 < gib < 1e9:
        raise WearcapError(f"a limit of {text[:30]!r} GiB", where, "a number above 0, such as 16")
    return int(gib * (1 << 30))


def _size(count: int) -> str:
    units = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))
    unit, name = next((known for known in units if count >= known[0]), (1, "bytes"))
    return f"{count / unit:.4g} {name}"


def _lift(size: int) -> str:
    return f"If you trust it, lift the limit: wearcap --max-file-gib {max(1, math.ceil(2 * size / (1 << 30)))} VERB …"
