"""Pictures one by one, from a video or from a folder of image files."""

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
from jaxtyping import UInt8

from wearcap.errors import WearcapError

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


def read_pictures(
    source: str | Path, max_count: int
) -> Iterator[tuple[str, UInt8[np.ndarray, "height width 3"]]]:
    """(name, RGB picture) of up to `max_count` files of a folder, in order of name, or evenly spaced frames of a video.

    Raises WearcapError when there is no picture, and for one that cannot be decoded, naming it.
    """
    source = Path(source)
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
        if not files:
            raise WearcapError("no pictures in this folder", where=source, expected=", ".join(SUFFIXES))
        wanted = np.unique(np.linspace(0, len(files) - 1, max_count).round().astype(int))
        for path in (files[k] for k in wanted):
            picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if picture is None:
                raise WearcapError("not a readable picture", where=path, expected="a whole image file")
            yield path.name, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    elif source.is_file():
        yield from _video_frames(source, max_count)
    else:
        raise WearcapError(
            "no such file or folder", where=source, expected="a video, or a folder of pictures"
        )


def _video_frames(path: Path, max_count: int) -> Iterator[tuple[str, np.ndarray]]:
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            step = max(1, -(-(stream.frames or max_count) // max_count))
            for number, frame in enumerate(container.decode(stream)):
                if number % step == 0:
                    yield f"frame {number}", frame.to_ndarray(format="rgb24")
    except (av.FFmpegError, IndexError) as error:
        raise WearcapError(
            f"not a readable video ({error})", where=path, expected="a whole video file"
        ) from error
