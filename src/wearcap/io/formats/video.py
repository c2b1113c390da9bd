"""Pictures as RGB arrays: image files, folders of them, and the frames of a video with their times; small videos written.

Only a few plain image formats are read, with a limited number of pixels: Pillow guesses the format from the content,
whatever the name says, and for some formats starts other programs (Ghostscript for EPS); half a megabyte of PNG may
unpack to gigabytes.
"""

import io
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from time import monotonic
from typing import Any, BinaryIO

import av
import numpy as np
from av.audio.stream import AudioStream
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import UInt8
from PIL import Image

from wearcap.boundary.limits import LIMITS, Budget
from wearcap.boundary.opening import explained, file_size, read_bytes, understood
from wearcap.errors import WearcapError
from wearcap.files import atomic_path

FORMATS = ("BMP", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
_PIXEL_BYTES = 4
_DAMAGE = (
    *(OSError, SyntaxError, ValueError, LookupError, TypeError, ArithmeticError, AttributeError),
    *(struct.error, zlib.error, EOFError, RuntimeError, MemoryError, Image.DecompressionBombError),
)
"""Exceptions that Pillow raises on truncated or damaged files."""


@contextmanager
def open_image(path: str | Path) -> Iterator[Image.Image]:
    """An image whose header has been read, its pixels not yet.

    Raises WearcapError, while opening or inside the `with` block, when the file is missing, none of `FORMATS`, damaged,
    or unpacks to more than `Budget` allows.
    """
    budget = Budget(path, "file", file_size(path, "picture"))
    content = io.BytesIO(read_bytes(path))  # no chunk of it can be longer than what is there
    with understood("not a readable picture", path, "a JPEG or PNG file", "Copy it again.", errors=_DAMAGE):  # noqa: SIM117
        with Image.open(content, formats=FORMATS) as image:
            budget.spend(_PIXEL_BYTES * image.width * image.height)
            yield image


_LIMITS = LIMITS["video"]
_MAX_FPS = 10_000
_WAIT_S = 5.0
"""Longest time (s) that FFmpeg may take for the next frame."""
_CONTAINERS = {
    "mov": re.compile(rb"....(?:ftyp|moov|mdat|free|skip|wide|pnot)", re.DOTALL),
    "matroska": re.compile(rb"\x1a\x45\xdf\xa3"),
    "avi": re.compile(rb"RIFF....AVI ", re.DOTALL),
}
"""FFmpeg's demuxers that are used, by how their files begin; others open further files, or follow lists of them."""
_TABLES = re.compile(rb"(?=(stsz|stz2|trun|elst|cmov))")
"""Boxes of an MP4 that number its samples and the entries of its edit list, and the one that packs them all."""
_FEW_SAMPLES = 1 << 20
"""Samples that any MP4 may announce: FFmpeg takes 24 to 72 bytes for each on opening, whether it is there or not."""


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
    with _open_video(path) as (container, stream):
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or 30)
        begin, number = None, -1
        for number, frame in enumerate(decoded(container, stream, path)):
            time = frame.time if frame.time is not None else number / rate
            begin = time if begin is None else begin
            if stop is not None and number >= stop:
                return
            if number >= start and (number - start) % step == 0:
                yield time - begin, frame.to_ndarray(format="rgb24")
        if number < 0:
            raise WearcapError("a video without frames", path)


def decoded(container: InputContainer, stream: VideoStream | AudioStream, path: str | Path) -> Iterator[Any]:
    """The frames of a stream, of which a file has no more than bytes, and each of which comes within `_WAIT_S`."""
    most, count, waited_s = file_size(path), 0, 0.0
    packets = container.demux()  # of all streams: between any two the time is checked
    while True:
        begin_s = monotonic()
        packet = next(packets, None)
        frames = [] if packet is None or packet.stream_index != stream.index else stream.decode(packet)
        waited_s = 0.0 if frames else waited_s + monotonic() - begin_s
        count += len(frames)
        if count > most or waited_s > _WAIT_S:
            what = f"more than {most} frames" if count > most else f"no frame within {_WAIT_S:g} s"
            raise WearcapError(what, path, "a complete video", "Copy it again.")
        yield from frames
        if packet is None:
            return


def _require_few_samples(file: BinaryIO, size: int, path: str | Path) -> None:
    """Raise WearcapError for an MP4 whose tables announce more samples than it has bytes: FFmpeg lists them on opening.

    They are looked for in all bytes but those of the pictures, for FFmpeg finds boxes at any depth.
    """
    budget, samples, edits, place = Budget(path, "video tables"), 0, 1, 0
    while place + 16 <= size:
        file.seek(place)
        length, kind, long_length = struct.unpack(">I4sQ", file.read(16))
        length = {0: size - place, 1: long_length}.get(length, length)
        if length < 8:
            break
        budget.spend(16 if kind == b"mdat" else 16 + min(length, size - place))
        file.seek(place)
        content = b"" if kind == b"mdat" else file.read(min(length, size - place))
        for found in _TABLES.finditer(content):
            at = found.start() + (12 if found[1].startswith(b"st") else 8)
            number = int.from_bytes(content[at : at + 4], "big")
            samples += _FEW_SAMPLES + size if found[1] == b"cmov" else 0 if found[1] == b"elst" else number
            edits += number if found[1] == b"elst" else 0
        place += length
    if samples * edits > max(size, _FEW_SAMPLES):
        what = "a header that is packed, or announces more samples than the file has bytes"
        raise WearcapError(what, path, "a complete video", "Convert it: ffmpeg -i FILE -c copy new.mp4")


@contextmanager
def open_container(path: str | Path) -> Iterator[InputContainer]:
    """An open video, of the container that its content shows; nothing but this file is read.

    What FFmpeg raises, also later, becomes a WearcapError; so does a file of another kind.
    """
    size = file_size(path, "video")
    expected, fix = "a complete MP4, MOV, MKV, WebM or AVI file", "Play it in a video player, or copy it again."
    with explained(path, "video"), open(path, "rb") as file:
        begin = file.read(12)
        demuxer = next((name for name, pattern in _CONTAINERS.items() if pattern.match(begin)), None)
        if demuxer is None:
            raise WearcapError("not a readable video", path, expected, fix)
        Budget(path, "video").spend(size)
        if demuxer == "mov":
            _require_few_samples(file, size, path)
        file.seek(0)
        options = {"protocol_whitelist": "none", "max_streams": "32", "max_pixels": str(_LIMITS.items)}
        damage = (av.FFmpegError, OSError, ValueError)
        with (
            understood("not a readable video", path, expected, fix, errors=damage),
            av.open(file, "r", demuxer, options, metadata_errors="replace", timeout=(_WAIT_S, None)) as container,
        ):
            assert isinstance(container, InputContainer)
            yield container


@contextmanager
def _open_video(path: str | Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """An open video and the stream of its pictures. Raises WearcapError as `open_container` does."""
    with open_container(path) as container:
        if not container.streams.video:
            raise WearcapError("a file without pictures", path, "a video")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise WearcapError("pictures packed in a way that is not known", path, "a video in H.264, say")
        stream.codec_context.options = {"max_pixels": str(_LIMITS.items)}  # for sizes that only the pictures have
        if not 0 < stream.width * stream.height <= _LIMITS.items:  # 0 where FFmpeg refuses them by its option
            what = f"pictures that are too large, or of no size ({stream.width}x{stream.height} pixels)"
            raise WearcapError(what, path, f"at most {_LIMITS.items} pixels", "Scale the video down.")
        yield container, stream


@dataclass(frozen=True)
class _VideoInfo:
    """Content of a video's header."""

    width: int
    height: int
    fps: float
    frames: int
    """Number of frames; 0 if neither it nor the duration is stated."""


def video_info(path: str | Path) -> _VideoInfo:
    """Size, average rate and length of a video. Raises WearcapError as `read_frames` does."""
    with _open_video(path) as (container, stream):
        fps = float(stream.average_rate or 30)
        frames = stream.frames or round((container.duration or 0) / av.time_base * fps)
        if not (0 < fps <= _MAX_FPS and 0 <= frames <= file_size(path)):
            what = f"a header that announces {frames} frames at {fps:.6g} per second"
            raise WearcapError(what, path, "no more frames than bytes", "The file was damaged: copy it again.")
        return _VideoInfo(stream.width, stream.height, fps, frames)


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
                what = f"a picture of {frame.shape[1]}x{frame.shape[0]} pixels"
                raise WearcapError(what, path, "even sizes, all alike")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if not count:
            raise WearcapError("no pictures to write", path)
        container.mux(stream.encode(None))
    return count


SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


def read_pictures(source: str | Path, max_count: int) -> Iterator[tuple[str, UInt8[np.ndarray, "height width 3"]]]:
    """Yield (name, RGB picture) of up to `max_count` files of a folder, by name, or evenly spaced frames of a video.

    Raises WearcapError when there is no picture, and for one that cannot be decoded, naming it.
    """
    source = Path(source)
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
        if not files:
            raise WearcapError("no pictures in this folder", source, ", ".join(SUFFIXES))
        wanted = np.unique(np.linspace(0, len(files) - 1, max_count).round().astype(int))
        for path in (files[k] for k in wanted):
            yield path.name, read_image(path)
    elif source.is_file():
        step = max(1, -(-video_info(source).frames // max_count))
        for count, (_, picture) in enumerate(read_frames(source, step=step)):
            yield f"frame {count * step}", picture
    else:
        raise WearcapError("no such file or folder", source, "a video, or a folder of pictures")
