"""Boundary check of untrusted image files: a few plain formats, with a limited number of pixels.

Pillow guesses the format from the content, whatever the name says, and for some formats starts other programs
(Ghostscript for EPS); half a megabyte of PNG may unpack to gigabytes.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from wearcap.errors import WearcapError
from wearcap.io.formats.bounded import Budget, file_size, read_bytes

FORMATS = ("BMP", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
_PIXEL_BYTES = 4
_DAMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    LookupError,
    TypeError,
    ArithmeticError,
    AttributeError,
    struct.error,
    zlib.error,
    EOFError,
    RuntimeError,
    MemoryError,
    Image.DecompressionBombError,
)
"""Exceptions that Pillow raises on truncated or damaged files."""


@contextmanager
def open_image(path: str | Path, max_bytes: int | None = None) -> Iterator[Image.Image]:
    """An image whose header has been read, its pixels not yet.

    Raises WearcapError, while opening or inside the `with` block, when the file is missing, none of `FORMATS`, damaged,
    or unpacks to more than `max_bytes`, by default as far as `Budget` goes.
    """
    budget = Budget(path, file_size(path, "picture"), max_bytes=max_bytes)
    content = io.BytesIO(read_bytes(path, max_bytes))  # no chunk of it can be longer than what is there
    try:
        with Image.open(content, formats=FORMATS) as image:
            budget.spend(_PIXEL_BYTES * image.width * image.height)
            yield image
    except _DAMAGE as error:
        raise WearcapError(
            f"not a readable picture ({error})"[:300], where=path, expected="a JPEG or PNG file", fix="Copy it again."
        ) from error
