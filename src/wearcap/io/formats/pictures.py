"""Pictures one by one, from a video or from a folder of image files."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from wearcap.errors import WearcapError
from wearcap.io.formats.video import read_frames, read_image, video_info

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


def read_pictures(source: str | Path, max_count: int) -> Iterator[tuple[str, UInt8[np.ndarray, "height width 3"]]]:
    """Yield (name, RGB picture) of up to `max_count` files of a folder, by name, or evenly spaced frames of a video.

    Raises WearcapError when there is no picture, and for one that cannot be decoded, naming it.
    """
    source = Path(source)
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
        if not files:
            raise WearcapError("no pictures in this folder", where=source, expected=", ".join(SUFFIXES))
        wanted = np.unique(np.linspace(0, len(files) - 1, max_count).round().astype(int))
        for path in (files[k] for k in wanted):
            yield path.name, read_image(path)
    elif source.is_file():
        step = max(1, -(-video_info(source).frames // max_count))
        for count, (_, picture) in enumerate(read_frames(source, step=step)):
            yield f"frame {count * step}", picture
    else:
        raise WearcapError("no such file or folder", where=source, expected="a video, or a folder of pictures")
