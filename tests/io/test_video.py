"""Videos and pictures that were written on the spot."""

import struct
import time
import zlib

import av
import numpy as np
import pytest
from PIL import Image

from wearcap.boundary.limits import Limits
from wearcap.errors import WearcapError
from wearcap.io.formats.video import read_frames, read_image, video_info, write_frames


def write_video(path, count: int = 12, rate: int = 25) -> None:
    """Frame k is gray 20 k."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for k in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 20 * k, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def test_frames_come_with_their_times(tmp_path):
    write_video(tmp_path / "a.mp4")
    times, pictures = zip(*read_frames(tmp_path / "a.mp4"))
    np.testing.assert_allclose(times, np.arange(12) / 25, atol=1e-6)
    assert {picture.shape for picture in pictures} == {(48, 64, 3)}
    np.testing.assert_allclose([picture.mean() for picture in pictures], 20 * np.arange(12), atol=4)
    part = list(read_frames(tmp_path / "a.mp4", 3, 6))
    np.testing.assert_allclose([time for time, _ in part], [0.12, 0.16, 0.2], atol=1e-6)
    np.testing.assert_allclose([picture.mean() for _, picture in part], [60, 80, 100], atol=4)


def test_what_is_no_video(tmp_path):
    with pytest.raises(WearcapError, match="no such video"):
        list(read_frames(tmp_path / "a.mp4"))
    (tmp_path / "a.mp4").write_bytes(b"no video at all, but some bytes")
    with pytest.raises(WearcapError, match="not a readable video"):
        list(read_frames(tmp_path / "a.mp4"))
    write_video(tmp_path / "b.mp4")
    (tmp_path / "a.mp4").write_bytes((tmp_path / "b.mp4").read_bytes()[:400])
    with pytest.raises(WearcapError, match="video"):
        list(read_frames(tmp_path / "a.mp4"))
    with av.open(str(tmp_path / "sound.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
    with pytest.raises(WearcapError, match="without pictures"):
        list(read_frames(tmp_path / "sound.mkv"))


def test_pictures_are_not_turned_by_their_exif(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (10, 20, 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)
    with pytest.raises(WearcapError, match="no such picture"):
        read_image(tmp_path / "b.png")
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    with pytest.raises(WearcapError, match="not a readable picture"):
        read_image(tmp_path / "b.png")


def png(width: int, height: int) -> bytes:
    """A black picture in a few bytes per thousand pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    pixels = zlib.compress(bytes((width + 7) // 8 * height + height), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def test_a_small_picture_that_unpacks_to_gigabytes_is_refused_unread(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(png(8000, 8000))
    with pytest.raises(WearcapError, match="more than 100 times its size.*--max-file-gib"):
        read_image(tmp_path / "a.png")
    monkeypatch.setenv("WEARCAP_MAX_FILE_GIB", "1")
    assert read_image(tmp_path / "a.png").shape == (8000, 8000, 3)


def test_no_program_is_started_for_a_picture(tmp_path, monkeypatch):
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: pytest.fail("a program was started"))
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n")
    with pytest.raises(WearcapError, match="not a readable picture.*identify"):
        read_image(tmp_path / "a.png")


def test_a_header_with_more_frames_than_bytes_is_refused(tmp_path):
    write_video(tmp_path / "a.mp4")
    content = bytearray((tmp_path / "a.mp4").read_bytes())
    place = content.index(b"stts") + 12  # how many frames last how long
    content[place : place + 4] = struct.pack(">I", 1 << 30)
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(WearcapError, match="announces 1073741824 frames"):
        video_info(tmp_path / "a.mp4")


def test_pictures_of_a_video_that_are_too_large_are_refused(tmp_path, monkeypatch):
    write_video(tmp_path / "a.mp4")
    monkeypatch.setattr("wearcap.io.formats.video._LIMITS", Limits(items=48 * 63))
    for read in (video_info, lambda path: list(read_frames(path))):
        with pytest.raises(WearcapError, match="pictures that are too large"):
            read(tmp_path / "a.mp4")


def test_written_pictures_come_back(tmp_path):
    shades = [np.full((32, 48, 3), 20 * k, np.uint8) for k in range(9)]
    assert write_frames(tmp_path / "a.mp4", iter(shades), 29.97) == 9
    times, pictures = zip(*read_frames(tmp_path / "a.mp4"))
    np.testing.assert_allclose(times, np.arange(9) / 29.97, atol=1e-3)
    np.testing.assert_allclose([picture.mean() for picture in pictures], 20 * np.arange(9), atol=4)


@pytest.mark.parametrize(
    ("shapes", "message"), [([], "no pictures"), ([(31, 48)], "48x31 pixels"), ([(32, 48), (32, 50)], "50x32 pixels")]
)
def test_pictures_that_make_no_video_are_named(shapes, message, tmp_path):
    with pytest.raises(WearcapError, match=f"a.mp4.*{message}"):
        write_frames(tmp_path / "a.mp4", (np.zeros((*shape, 3), np.uint8) for shape in shapes), 30.0)
    assert not list(tmp_path.iterdir())


LISTS = {
    "a list of FFmpeg's": "ffconcat version 1.0\n" + "file a.mp4\n" * 500,
    "a list without a first line": "file 'a.mp4'\n" * 500,
    "a playlist": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n" + "#EXTINF:1,\na.mp4\n" * 500,
    "a playlist without an end": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nnone.ts\n",
    "a description of a session": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
    "a manifest": '<?xml version="1.0"?><MPD type="dynamic"><Period/></MPD>',
    "metadata": ";FFMETADATA1\ntitle=x\n",
}


@pytest.mark.parametrize("name", ["x.mp4", "x.mov", "x.mkv", "x.avi", "x.m3u8", "x.ffconcat"])
@pytest.mark.parametrize("listed", LISTS)
def test_lists_of_videos_are_not_followed(listed, name, tmp_path):
    write_video(tmp_path / "a.mp4")
    (tmp_path / name).write_text(LISTS[listed])
    for read in (video_info, lambda path: list(read_frames(path))):
        begin = time.monotonic()
        with pytest.raises(WearcapError, match="not a readable video"):
            read(tmp_path / name)
        assert time.monotonic() - begin < 1


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi"])
def test_every_container_is_read_whatever_its_name(suffix, tmp_path):
    write_video(tmp_path / f"a{suffix}")
    (tmp_path / "b.mp4").write_bytes((tmp_path / f"a{suffix}").read_bytes())
    times, pictures = zip(*read_frames(tmp_path / "b.mp4"))
    assert len(times) == 12
    np.testing.assert_allclose(times, np.arange(12) / 25, atol=1e-3)
    np.testing.assert_allclose([picture.mean() for picture in pictures], 20 * np.arange(12), atol=4)


def test_a_video_has_no_more_frames_than_bytes(tmp_path, monkeypatch):
    write_video(tmp_path / "a.mp4")
    monkeypatch.setattr("wearcap.io.formats.video.file_size", lambda path, kind="": 3)
    with pytest.raises(WearcapError, match="more than 3 frames"):
        list(read_frames(tmp_path / "a.mp4"))


def test_a_video_whose_frames_do_not_come_is_given_up(tmp_path, monkeypatch):
    write_video(tmp_path / "a.mp4")
    monkeypatch.setattr("wearcap.io.formats.video._WAIT_S", -1.0)
    with pytest.raises(WearcapError, match="no frame within"):
        list(read_frames(tmp_path / "a.mp4"))
