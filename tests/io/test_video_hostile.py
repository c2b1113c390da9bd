"""Videos whose headers announce more than is there, that refer to other files, or give nothing for long."""

import json
import struct
import subprocess
import sys

import av
import numpy as np
import pytest
import torch
from test_video import write_video

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.video import open_container, read_frames
from wearcap.recording import CameraStream
from wearcap.sensors.claps import camera_claps


def widened(content: bytes, boxes: list[bytes], extra: bytes) -> bytes:
    """Bytes put at the end of the last of nested boxes; the header stands behind the pictures, which do not move."""
    whole, place = bytearray(content), 0
    for box in boxes:
        place = whole.index(box, place)
        whole[place - 4 : place] = struct.pack(">I", struct.unpack_from(">I", whole, place - 4)[0] + len(extra))
    end = place - 4 + struct.unpack_from(">I", whole, place - 4)[0] - len(extra)
    whole[end:end] = extra
    return bytes(whole)


def patched(content: bytes, box: bytes, offset: int, *values: int) -> bytes:
    place = content.index(box) + offset
    return content[:place] + struct.pack(f">{len(values)}I", *values) + content[place + 4 * len(values) :]


def test_an_mp4_reads_no_other_file(tmp_path):
    """A data reference to another file (dref with url) instead of "the same file"."""
    write_video(tmp_path / "good.mp4")
    write_video(tmp_path / "a.mp4")
    url = (tmp_path / "good.mp4").as_uri().encode() + b"\0"
    content = (tmp_path / "a.mp4").read_bytes()
    content = widened(content, [b"moov", b"trak", b"mdia", b"minf", b"dinf", b"dref", b"url "], url)
    content = patched(content, b"url ", 4, 0)  # not in this file
    place = content.index(b"mdat")
    length = struct.unpack_from(">I", content, place - 4)[0]
    (tmp_path / "a.mp4").write_bytes(content[: place + 4] + bytes(length - 8) + content[place - 4 + length :])
    with pytest.raises(WearcapError):
        list(read_frames(tmp_path / "a.mp4"))


def child(code: str) -> dict:
    """What a child process prints, and its largest memory (MiB) beyond that of the imports."""
    before = "import json, resource, sys\nfrom wearcap.errors import WearcapError\n"
    before += "from wearcap.io.formats.video import *\nm = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024\nb = m()\n"
    script = before + code + "\nprint(json.dumps({'error': error, 'mib': m() - b}))"
    return json.loads(
        subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, timeout=60).stdout
    )


def reading(path) -> dict:
    return child(f"try:\n    video_info({str(path)!r}); error = ''\nexcept WearcapError as e:\n    error = str(e)")


@pytest.mark.parametrize("tables", ["samples", "fragments", "hidden", "edits"])
def test_an_mp4_that_announces_more_samples_than_bytes(tables, tmp_path):
    path = tmp_path / "a.mp4"
    write_video(path, count=13)
    content = path.read_bytes()
    many = 40_000_000
    if tables in ("samples", "hidden"):
        content = patched(content, b"stsz", 8, 100, many)
        content = patched(patched(content, b"stsc", 16, many), b"stts", 12, many)
        if tables == "hidden":  # FFmpeg finds a header in what is free
            content = content.replace(b"moov", b"free")
    elif tables == "edits":
        edit = content[content.index(b"elst") + 12 :][:12]
        content = widened(content, [b"moov", b"trak", b"edts", b"elst"], edit * 400_000)
        content = patched(content, b"elst", 8, 400_001)
    else:
        options = {"movflags": "frag_keyframe+empty_moov"}
        with av.open(str(path), "w", options=options) as container:
            stream = container.add_stream("mpeg4", rate=25)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")))
            container.mux(stream.encode(None))
        content = patched(path.read_bytes(), b"trun", 4, 1, many)
    path.write_bytes(content)
    found = reading(path)
    assert "more samples than" in found["error"], found
    assert found["mib"] < 60


def write_sound(path, count: int = 40) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("flac", rate=16_000, layout="mono")
        for k in range(count):
            sound = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.int16), format="s16", layout="mono")
            sound.rate, sound.pts = 16_000, 4096 * k
            container.mux(stream.encode(sound))
        container.mux(stream.encode(None))


def test_sound_is_bounded_as_pictures_are(tmp_path, monkeypatch):
    write_sound(tmp_path / "a.mkv")
    camera = CameraStream(
        torch.zeros(1).double(), Camera.pinhole(64, 64, 60), torch.eye(3), torch.zeros(3), video="a.mkv"
    )
    with pytest.raises(WearcapError, match="no clap found"):
        camera_claps(camera, tmp_path)
    monkeypatch.setattr("wearcap.io.formats.video._WAIT_S", 0.0)
    with pytest.raises(WearcapError, match="no frame within|not a readable video"):
        camera_claps(camera, tmp_path)


def test_no_more_than_32_streams_are_opened(tmp_path):
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        streams = [container.add_stream("mpeg4", rate=25) for _ in range(33)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
        for stream in streams:
            container.mux(stream.encode(picture))
            container.mux(stream.encode(None))
    with open_container(tmp_path / "a.mkv") as container:
        assert len(container.streams) == 32
