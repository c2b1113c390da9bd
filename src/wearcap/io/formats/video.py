"""Pictures as RGB arrays: single image files, and the frames of a video with their times; writing a small video."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import UInt8

from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.io.formats.bounded import file_size
from wearcap.io.formats.image_file import open_image

MAX_PIXELS = 1 << 26
"""Most pixels of a video's picture (8192 x 8192)."""
_MAX_FPS = 10_000


def read_image(path: str | Path) -> UInt8[np.ndarray, "height width 3"]:
    """Pixels of an image file as stored, which calibrations refer to: no EXIF rotation is applied.

    Raises WearcapError as `open_image` does.
    """
    with open_image(path) as image:
        return np.asarray(image.convert("RGB"))


def read_frames(
    path: str | Path, start: int = 0, stop: int | None = None, step: int = 1
) -> Iterator[tuple[float, UInt8[np.ndarray, "height width 3"]]]:
    """Yield every `step`-th of the frames `start` to `stop` of a video: time (s) from its first frame, and picture.

    Times are those written in the file; where it has none, frames follow its average rate.
    Raises WearcapError when the file is missing, damaged or without pictures.
    """
    file_size(path, "video")
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            stream = _pictures_of(container, path)
            stream.thread_type = "AUTO"
            rate = float(stream.average_rate or 30)
            begin: float | None = None
            number = -1
            for number, frame in enumerate(container.decode(stream)):
                time = frame.time if frame.time is not None else number / rate
                begin = time if begin is None else begin
                if stop is not None and number >= stop:
                    return
                if number >= start and (number - start) % step == 0:
                    yield time - begin, frame.to_ndarray(format="rgb24")
            if number < 0:
                raise WearcapError("a video without frames", where=path)
    except (av.FFmpegError, OSError) as error:
        raise WearcapError(
            f"not a readable video ({error})",
            where=path,
            expected="a complete MP4, MKV or AVI file",
            fix="Play it in a video player, or copy it again.",
        ) from error


def _pictures_of(container: InputContainer, path: str | Path) -> VideoStream:
    """The stream of a video's pictures."""
    if not container.streams.video:
        raise WearcapError("a file without pictures", where=path, expected="a video")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise WearcapError("pictures packed in a way that is not known", where=path, expected="a video in H.264, say")
    stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}  # for sizes that only the pictures have
    if stream.width * stream.height > MAX_PIXELS:
        raise WearcapError(
            f"pictures of {stream.width}x{stream.height} pixels",
            where=path,
            expected=f"at most {MAX_PIXELS} pixels",
            fix="Scale the video down.",
        )
    return stream


@dataclass(frozen=True)
class VideoInfo:
    """Content of a video's header."""

    width: int
    height: int
    fps: float
    frames: int
    """Number of frames; 0 if neither it nor the duration is stated."""


def video_info(path: str | Path) -> VideoInfo:
    """Size, average rate and length of a video. Raises WearcapError as `read_frames` does."""
    size = file_size(path, "video")
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            stream = _pictures_of(container, path)
            fps = float(stream.average_rate or 30)
            frames = stream.frames or round((container.duration or 0) / av.time_base * fps)
            if not (stream.width > 0 and stream.height > 0):
                raise WearcapError(f"pictures of {stream.width}x{stream.height} pixels", where=path, expected="a video")
            if not (0 < fps <= _MAX_FPS and 0 <= frames <= size):
                raise WearcapError(
                    f"a header that announces {frames} frames at {fps:.6g} per second",
                    where=path,
                    expected="no more frames than bytes",
                    fix="The file was damaged: copy it again.",
                )
            return VideoInfo(stream.width, stream.height, fps, frames)
    except (av.FFmpegError, OSError) as error:
        raise WearcapError(f"not a readable video ({error})", where=path, expected="a video file") from error


def video_encoder(crf: int) -> tuple[str, dict[str, str]]:
    """Name and options of an encoder that maps equal pictures to equal bytes; `crf` is H.264's quality, smaller is better."""
    if "libx264" not in av.codecs_available:
        return "mpeg4", {"threads": "1"}
    # With x264's mbtree the bytes differ from one process to the next.
    return "libx264", {"crf": str(crf), "preset": "veryfast", "threads": "1", "x264-params": "mbtree=0"}


def write_frames(
    path: str | Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], fps: float, crf: int = 18
) -> int:
    """Write pictures of one even size as an MP4 (H.264 where PyAV has it, else MPEG-4); returns how many.

    `crf` is H.264's quality, smaller is better. Raises WearcapError for odd or changing sizes, and for no frames.
    """
    count = 0
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        codec, options = video_encoder(crf)
        stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001), options=options)
        assert isinstance(stream, av.VideoStream)
        size = (0, 0)
        for count, frame in enumerate(frames, 1):
            if count == 1:
                size = (frame.shape[1], frame.shape[0])
                stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            if (frame.shape[1], frame.shape[0]) != size or size[0] % 2 or size[1] % 2:
                raise WearcapError(
                    f"a picture of {frame.shape[1]}x{frame.shape[0]} pixels",
                    where=path,
                    expected="even sizes, all alike",
                )
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if not count:
            raise WearcapError("no pictures to write", where=path)
        container.mux(stream.encode(None))
    return count
