import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from wearcap.errors import WearcapError
from wearcap.io.formats.pcd import _lzf_decompressed, read_pcd
from wearcap.io.formats.ply import Ply, read_ply, write_ply

CLOUD = Ply(
    np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32),
    np.random.default_rng(1).integers(0, 255, (40, 3)).astype(np.uint8),
    np.random.default_rng(2).integers(0, 40, (25, 3)).astype(np.int32),
)


def assert_same(a: Ply, b: Ply):
    np.testing.assert_allclose(a.points, b.points, rtol=1e-6)
    np.testing.assert_array_equal(a.colors, b.colors)
    np.testing.assert_array_equal(a.faces, b.faces)


def foreign_ply(kind: str) -> bytes:
    """The cloud written by hand: doubles, an extra property, quads among the triangles."""
    header = (
        f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex 4\nproperty double x\nproperty double y\n"
        "property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nproperty float quality\n"
        "element face 2\nproperty list uchar int vertex_index\nend_header\n"
    )
    vertices = [(0, 0, 0, 1, 0, 1, 0.5), (1, 0, 0, 0, 1, 0, 0.5), (1, 1, 0, 1, 1, 1, 0.5), (0, 1, 0, 0, 0, 0, 0.5)]
    faces = [(3, 0, 1, 2), (4, 0, 1, 2, 3)]
    if kind == "ascii":
        return (header + "".join(" ".join(map(str, row)) + "\n" for row in vertices + faces)).encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(f"{order}dddBBBf", *row) for row in vertices)
    return header.encode() + body + b"".join(struct.pack(f"{order}B{row[0]}i", *row) for row in faces)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_encoding_reads_alike(tmp_path, kind):
    (tmp_path / "a.ply").write_bytes(foreign_ply(kind))
    ply = read_ply(tmp_path / "a.ply")
    assert ply.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert ply.colors is not None
    assert ply.colors[0].tolist() == [1, 0, 1]
    assert ply.faces is not None
    assert ply.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("name", "code"), [("uchar", "B"), ("ushort", "H"), ("uint", "I"), ("char", "b"), ("int", "i")]
)
def test_corners_of_every_whole_type_are_read(tmp_path, name, code):
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        f"property float z\nelement face 1\nproperty list uchar {name} vertex_indices\nend_header\n"
    )
    for corner in (1, 3):
        face = struct.pack(f"<B3{code}", 3, 0, 2, corner)
        (tmp_path / "a.ply").write_bytes(header.encode() + struct.pack("<9f", *range(9)) + face)
        if corner == 1:
            assert read_ply(tmp_path / "a.ply").faces.tolist() == [[0, 2, 1]]
        else:
            with pytest.raises(WearcapError, match="a face names vertex 3, there are 3"):
                read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("part", ["points", "colors", "all"])
def test_round_trip(tmp_path, part):
    ply = Ply(CLOUD.points, None if part == "points" else CLOUD.colors, CLOUD.faces if part == "all" else None)
    write_ply(ply, tmp_path / "a.ply")
    assert_same(read_ply(tmp_path / "a.ply"), ply)


def test_trimesh_agrees_both_ways(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    for encoding in ("ascii", "binary"):
        (tmp_path / "box.ply").write_bytes(trimesh.exchange.ply.export_ply(box, encoding=encoding))
        ply = read_ply(tmp_path / "box.ply")
        assert ply.faces is not None
        np.testing.assert_allclose(trimesh.Trimesh(ply.points, ply.faces).volume, 6.0, rtol=1e-5)
    write_ply(ply, tmp_path / "ours.ply")
    theirs = trimesh.load(tmp_path / "ours.ply")
    assert theirs.volume == pytest.approx(6.0, rel=1e-5)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_every_truncation_is_named(tmp_path, kind):
    whole = foreign_ply(kind)
    for length in range(0, len(whole) - 2, 3):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(WearcapError, match=r"cut\.ply"):
            read_ply(tmp_path / "cut.ply")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"format ascii", b"format morse", "header cannot be understood"),
        (b"property double x", b"property double u", "no vertices with x, y, z"),
        (b"property double x", b"property quad x", "header cannot be understood"),
        (b"element vertex 4", b"element vertex -4", "negative count"),
        (b"3 0 1 2\n", b"3 0 1 9\n", "vertex 9"),
        (b"1 1 0 1", b"nan 1 0 1", "NaN"),
        (b"ply\n", b"PK\x03\x04", "not a PLY"),
    ],
)
def test_defects_are_named(tmp_path, old, new, message):
    (tmp_path / "bad.ply").write_bytes(foreign_ply("ascii").replace(old, new, 1))
    with pytest.raises(WearcapError, match=message):
        read_ply(tmp_path / "bad.ply")


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_files_never_crash(tmp_path_factory, data):
    """Any byte may be changed: the reader reads or refuses, it does not fall over."""
    folder = tmp_path_factory.mktemp("fuzz")
    name = data.draw(st.sampled_from(["a.ply", "b.ply", "c.pcd", "d.pcd"]))
    kind = {"a.ply": "ascii", "b.ply": "binary_little_endian", "c.pcd": "ascii", "d.pcd": "binary_compressed"}[name]
    content = bytearray(foreign_ply(kind) if name.endswith("ply") else pcd_bytes(kind))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (folder / name).write_bytes(bytes(content))
    try:
        cloud = (read_ply if name.endswith("ply") else read_pcd)(folder / name)
        assert np.isfinite(cloud.points).all()
    except WearcapError:
        pass


POINTS = np.array([[0, 1, 2], [3, 4, 5], [np.nan, 0, 0], [6, 7, 8.5]], dtype="<f4")
PACKED = np.array([0xFF0000, 0x00FF00, 0, 0x0000FF], dtype="<u4")


def pcd_bytes(kind: str) -> bytes:
    header = f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA {kind}\n"
    if kind == "ascii":
        return (header + "".join(f"{x} {y} {z} {c}\n" for (x, y, z), c in zip(POINTS, PACKED))).encode()
    if kind == "binary":
        return header.encode() + b"".join(p.tobytes() + c.tobytes() for p, c in zip(POINTS, PACKED))
    plain = POINTS.T.tobytes() + PACKED.tobytes()
    literal = b"".join(bytes([len(part) - 1]) + part for part in (plain[i : i + 32] for i in range(0, len(plain), 32)))
    return header.encode() + struct.pack("<II", len(literal), len(plain)) + literal


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_encodings(tmp_path, kind):
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(kind))
    cloud = read_pcd(tmp_path / "a.pcd")
    assert cloud.points.tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8.5]]
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_every_pcd_truncation_is_named(tmp_path, kind):
    whole = pcd_bytes(kind)
    stop = len(whole) - (12 if kind == "ascii" else 1)
    for length in range(0, stop, 5):
        (tmp_path / "cut.pcd").write_bytes(whole[:length])
        with pytest.raises(WearcapError, match=r"cut\.pcd"):
            read_pcd(tmp_path / "cut.pcd")


def test_lzf_references():
    """A literal "abc", then 6 bytes from 3 back (overlapping), then 12 from 9 back with a long length."""
    data = bytes([2]) + b"abc" + bytes([(6 - 2) << 5, 2]) + bytes([7 << 5, 12 - 9, 8])
    assert _lzf_decompressed(data, 21) == b"abc" * 7
    with pytest.raises(ValueError):
        _lzf_decompressed(data, 20)
    with pytest.raises(ValueError):
        _lzf_decompressed(bytes([(6 - 2) << 5, 2]), 6)


@pytest.mark.real
def test_real_room_scan(real_data):
    """The tutorial's scan: 112,586 points of a room a few metres high."""
    cloud = read_pcd(real_data / "pcl_room_scan" / "tutorials" / "room_scan1.pcd")
    assert cloud.points.shape == (112586, 3)
    size = cloud.points.max(0) - cloud.points.min(0)
    assert (size > [10, 10, 2]).all()
    assert (size < [40, 40, 4]).all()
