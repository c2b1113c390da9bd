"""Files of strangers: bombs, impossible counts, and what is no regular file are refused quickly and in small memory."""

import gzip
import io
import json
import lzma
import os
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from data_prep.hcontact import read_smpl_json
from wearcap.boundary import limits
from wearcap.boundary.arrays import read_npz
from wearcap.boundary.pickles import read_pickle
from wearcap.boundary.texts import read_json, read_text, read_yaml_object
from wearcap.errors import WearcapError
from wearcap.io.formats.asf_amc import read_asf
from wearcap.io.formats.bvh import read_bvh_content
from wearcap.io.formats.camera_json import read_photos
from wearcap.io.formats.colmap import read_colmap
from wearcap.io.formats.mvnx import read_mvnx
from wearcap.io.formats.ocamcalib import OCamModel
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.trajectory import read_trajectory
from wearcap.io.formats.video import read_frames, read_image, video_info
from wearcap.io.formats.wavefront import read_obj

MIB = 1 << 20
READERS = {
    "a.txt": read_trajectory,
    "a.csv": read_trajectory,
    "a.bvh": read_bvh_content,
    "a.asf": read_asf,
    "a.mvnx": read_mvnx,
    "a.npz": read_npz,
    "a.ply": read_ply,
    "a.pcd": read_pcd,
    "a.json": read_json,
    "a.pkl": read_pickle,
    "a.obj": read_obj,
    "a.json.zip": read_smpl_json,
    "a.png": read_image,
    "a.mp4": video_info,
    "b.mp4": lambda path: list(read_frames(path)),
}


def packed(opener, path: Path, line: bytes, size: int) -> Path:
    """A file that unpacks to `size` bytes of one line."""
    with opener(path, "wb") as file:
        for _ in range(size // (1000 * len(line))):
            file.write(1000 * line)
    return path


MOST_S = 60.0


def refused(read, path: Path, message: str, most_mib: float = 80) -> str:
    """The message, after little memory, and after no more CPU time than what does not hang takes on any machine."""
    tracemalloc.start()
    begin = time.process_time()
    try:
        with pytest.raises(WearcapError, match=message) as caught:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < most_mib * MIB
    finally:
        tracemalloc.stop()
    assert time.process_time() - begin < MOST_S
    return str(caught.value)


# Bombs -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def little_free(monkeypatch):
    """The ratio counts from 1 MiB on, so that the tests' bombs stay small."""
    monkeypatch.setattr(limits, "FREE_BYTES", MIB)


@pytest.mark.parametrize(("ending", "opener"), [(".gz", gzip.open), (".xz", lzma.open)])
@pytest.mark.parametrize(
    ("name", "read", "line"),
    [
        ("a.txt", read_trajectory, b"0 1 2 3 0 0 0 1\n"),
        ("a.csv", read_trajectory, b"1,0,0,0,1,0,0,0\n"),
        ("a.bvh", read_text, b"JOINT a {\n"),
        ("a.mvnx", read_mvnx, b"<!-- a comment -->\n"),
    ],
)
def test_packed_bombs(little_free, tmp_path, ending, opener, name, read, line):
    path = packed(opener, tmp_path / (name + ending), line, 8 * MIB)
    reason = refused(read, path, "unpacks to more than 100 times its size|without an element|broken XML")
    if read is not read_mvnx:
        assert "wearcap --max-file-gib" in reason


def test_an_archive_of_large_arrays(little_free, tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", **{f"a{k}": np.zeros(MIB // 16) for k in range(4)})
    refused(read_npz, tmp_path / "a.npz", "100 times its size")
    assert len(read_npz(tmp_path / "a.npz", ["a0"])["a0"]) == MIB // 16, "what is not asked for does not count"
    monkeypatch.setenv(limits.VARIABLE, str(2 / 1024))
    assert len(read_npz(tmp_path / "a.npz")) == 4
    monkeypatch.setenv(limits.VARIABLE, str(1 / 1024))
    with pytest.raises(WearcapError, match="larger than 1 MiB once unpacked"):
        read_npz(tmp_path / "a.npz")


def test_a_zipped_json_bomb(little_free, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.json.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.json", b"[" + b" " * 16 * MIB + b"]")
    refused(read_smpl_json, tmp_path / "a.json.zip", "100 times its size")


def test_the_limit_is_lifted_by_the_user(little_free, tmp_path, monkeypatch):
    path = packed(gzip.open, tmp_path / "a.txt.gz", b"words of a text\n", 8 * MIB)
    with pytest.raises(WearcapError, match="--max-file-gib"):
        read_text(path)
    monkeypatch.setenv(limits.VARIABLE, "1")
    assert len(read_text(path)) > 7 * MIB
    monkeypatch.setenv(limits.VARIABLE, "0.001")
    with pytest.raises(WearcapError, match=r"larger than 1 MiB|larger than 1024 KiB|larger than 1.*once unpacked"):
        read_text(path)
    for wrong in ("much", "-1", "nan", "0"):
        monkeypatch.setenv(limits.VARIABLE, wrong)
        with pytest.raises(WearcapError, match="WEARCAP_MAX_FILE_GIB: a limit of"):
            read_text(path)


def test_the_option_of_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv(limits.VARIABLE, "")  # so that it is put back
    (tmp_path / "t.txt").write_text("".join(f"{k / 50} 0 0 0 0 0 0 1\n" for k in range(500)))
    assert exit_main("--max-file-gib", "1e-6", "doctor", "--json", str(tmp_path / "t.txt")) == 1
    assert "larger than 1.048 KiB once unpacked" in capsys.readouterr().out
    assert exit_main("--max-file-gib=1", "doctor", str(tmp_path / "t.txt")) == 0
    assert os.environ[limits.VARIABLE] == "1"
    for wrong in (["--max-file-gib", "lots", "doctor"], ["--max-file-gib"]):
        assert exit_main(*wrong) == 2
        assert "max_file_gib: a limit of" in capsys.readouterr().err
    exit_main("--help")
    assert "max_file_gib=N reads files of up to N GiB" in capsys.readouterr().out


def exit_main(*arguments: str) -> int:
    from wearcap.cli.main import main

    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return ended.value.code  # pyright: ignore[reportReturnType]


# Counts that cannot be ----------------------------------------------------------------------------------------------

BVH_JOINT = "JOINT j%d\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
PLY = "ply\nformat {form} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {count}\nproperty list {kind} int vertex_indices\n"
LONG_LIST = (
    PLY.format(form="binary_little_endian", count=0) + FACES.format(count=1, kind="uint") + "end_header\n"
).encode() + b"\xff" * 40
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT {count}\nWIDTH 1\nHEIGHT 1\nPOINTS {points}\nDATA {form}\n1 2 3\n"


def npy_of(shape: tuple) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + bytes(64)


COUNTS = {
    "many joints.bvh": "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    + "".join(BVH_JOINT % k + "}\n" for k in range(30_000)),
    "deep joints.bvh": "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    + "".join(BVH_JOINT % k for k in range(30_000)),
    "channels.bvh": "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 1000000000000 Zrotation\n",
    "bones.asf": ":units\n:root\norder RX\naxis XYZ\nposition 0 0 0\norientation 0 0 0\n:bonedata\n"
    + "".join(f"begin\nname b{k}\ndirection 0 0 1\nlength 1\naxis 0 0 0 XYZ\nend\n" for k in range(20_000)),
    "points ascii.ply": PLY.format(form="ascii", count=10**12) + "end_header\n0 0 0\n",
    "points.ply": PLY.format(form="binary_little_endian", count=10**12) + "end_header\n0 0 0\n",
    "more points.ply": PLY.format(form="binary_little_endian", count=10**30) + "end_header\n0 0 0\n",
    "long list.ply": LONG_LIST,
    "list by floats.ply": LONG_LIST.replace(b"list uint", b"list float"),
    "list by signs.ply": LONG_LIST.replace(b"list uint", b"list int"),
    "twice.ply": PLY.format(form="ascii", count=1) + "property float x\nend_header\n0 0 0 0\n",
    "count.pcd": PCD.format(count="1 0 0", points=1, form="ascii"),
    "huge count.pcd": PCD.format(count="1 1 1000000000000", points=1, form="ascii"),
    "points.pcd": PCD.format(count="1 1 1", points=10**12, form="ascii"),
    "binary points.pcd": PCD.format(count="1 1 1", points=10**12, form="binary"),
    "packed points.pcd": PCD.format(count="1 1 1", points=10**12, form="binary_compressed"),
    "digits.pcd": PCD.format(count="1 1 1", points="9" * 5000, form="binary"),
}


@pytest.mark.parametrize("name", COUNTS)
def test_impossible_counts(tmp_path, name):
    content = COUNTS[name]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    read = READERS[f"a{path.suffix}"]
    refused(read, path, name.split(".")[1], most_mib=30)


@pytest.mark.parametrize("shape", [(10**12,), (10**9, 10**9, 10**9), (-1,)])
def test_an_array_larger_than_its_archive(tmp_path, shape):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", npy_of(shape))
    refused(read_npz, tmp_path / "a.npz", "shape", most_mib=10)


@pytest.mark.parametrize("order", "<>")
def test_characters_that_are_none(tmp_path, order):
    """Python ends with a SystemError where such text is made a string."""
    text = np.array([0x61, 0x7FFFFFFF], f"{order}u4").view(f"{order}U1")
    np.savez(tmp_path / "a.npz", a=text)
    refused(read_npz, tmp_path / "a.npz", "characters")
    np.savez(tmp_path / "a.npz", a=np.array(["aä\U0001f600"], f"{order}U3"))
    assert str(read_npz(tmp_path / "a.npz")["a"][0]) == "aä\U0001f600"


def test_lenses_of_impossible_images():
    model = OCamModel((-200.0, 0.0, 1e-3), (), 2.0, 2.0, (1.0, 0.0, 0.0), width=10**300, height=10**300)
    with pytest.raises(WearcapError, match="sizes of 1 to"):
        model.camera()


# Nesting -----------------------------------------------------------------------------------------------------------

DEEP = ["[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100_000 + "1" + "}" * 100_000]


@pytest.mark.parametrize("text", DEEP)
def test_deep_json(tmp_path, text):
    for name in ("a.json", "photos.json"):
        (tmp_path / name).write_text(text)
    with zipfile.ZipFile(tmp_path / "a.json.zip", "w") as archive:
        archive.writestr("data.json", text)
    np.savez(tmp_path / "a.npz", wearcap=np.array(text))
    from wearcap.io.formats.motion_npz import read_motion

    for read, path in (
        (read_json, "a.json"),
        (read_smpl_json, "a.json"),
        (read_smpl_json, "a.json.zip"),
        (read_photos, "."),
        (read_motion, "a.npz"),
    ):
        refused(read, tmp_path / path, "too deeply")


def test_whole_numbers_of_json_beyond_64_bits(tmp_path):
    for number in ("9" * 400, "-" + "9" * 30, "1" + "0" * 5000):
        (tmp_path / "a.json").write_text(f'{{"a": {number}}}')
        refused(read_json, tmp_path / "a.json", "not readable JSON")


def test_yaml_that_unfolds(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40)))
    refused(read_yaml_object, path, "refers to its own parts")
    path.write_text("a: " + "[" * 20_000)
    refused(read_yaml_object, path, "YAML")
    path.write_text("a: " + "x" * 100_000)
    refused(read_yaml_object, path, "larger than 64 KiB")


# What is no regular file ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file(tmp_path, name):
    read = READERS[name]
    (tmp_path / name).mkdir()
    refused(read, tmp_path / name, "a folder")
    pipe = tmp_path / f"pipe_{name}"
    os.mkfifo(pipe)
    refused(read, pipe, "a pipe")
    device = tmp_path / f"device_{name}"
    device.symlink_to("/dev/zero")
    refused(read, device, "a device")
    refused(read, tmp_path / f"none_{name}", "no such (file|picture|video)")
    refused(read, tmp_path / f"a\0_{name}", "a name that no file can have")
    refused(read, tmp_path / ("n" * 300 + name), "cannot be read")


@pytest.mark.parametrize("name", READERS)
def test_a_file_that_may_not_be_read(tmp_path, name, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("wearcap.boundary.opening.os.stat", refuse)
    assert "chmod" in refused(READERS[name], tmp_path / name, "no permission")


@pytest.mark.parametrize("name", ["a.txt", "a.bvh", "a.npz", "a.ply", "a.pkl", "a.json", "a.json.zip"])
def test_a_file_that_may_be_seen_but_not_opened(tmp_path, name, monkeypatch):
    (tmp_path / name).write_bytes(b"something")

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("builtins.open", refuse)
    monkeypatch.setattr("io.open", refuse)
    with pytest.raises(WearcapError, match="no permission"):
        READERS[name](tmp_path / name)


def test_colmap_lines_are_no_bombs(tmp_path):
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("1" * 5000 + " PINHOLE 1 1\n")
    refused(read_colmap, tmp_path, "cameras.txt")


def test_an_empty_list_is_json(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps([]))
    assert read_json(tmp_path / "a.json") == []


@pytest.mark.parametrize("dtype", ["<f8,<f4", "M8[s]", "V4"])
def test_arrays_of_neither_numbers_nor_text(tmp_path, dtype):
    np.savez(tmp_path / "a.npz", np.zeros(3, dtype))
    with pytest.raises(WearcapError, match="an array of"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("text", ['{"name": "\\ud800"}', '["\\uDFFF"]', '{"\\ud83d": 1}'])
def test_halves_of_characters_are_no_text(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    refused(read_json, tmp_path / "a.json", "not readable JSON")
    (tmp_path / "a.json").write_text('["\\ud83d\\ude00"]')
    assert read_json(tmp_path / "a.json") == ["😀"]
