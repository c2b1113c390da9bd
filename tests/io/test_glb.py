"""Surfaces of .glb files: what is there comes back, and nothing takes more than the file's bytes explain."""

import gzip
import io
import json
import struct
import zipfile

import numpy as np
import pytest
import trimesh

from hostile import in_time
from wearcap.apps.viewer.page_layers import read_scene
from wearcap.errors import WearcapError
from wearcap.io.formats.environment import read_environment
from wearcap.io.formats.glb import read_glb
from wearcap.io.formats.ply import Ply, write_ply

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3]], np.uint16)


def content(**changes) -> dict:
    """A tetrahedron of three faces, in one node."""
    tree = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 9, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 18}],
        "buffers": [{"byteLength": 66}],
    }
    return tree | changes


def glb(tree: dict, binary: bytes = VERTICES.tobytes() + FACES.tobytes() + b"\0\0") -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def test_triangles_come_back_at_the_places_of_their_nodes(tmp_path):
    nodes = [{"children": [1, 2], "translation": [1, 2, 3]}, {"mesh": 0, "scale": [2, 2, 2]}, {"mesh": 0}]
    (tmp_path / "a.glb").write_bytes(glb(content(nodes=nodes)))
    mesh = read_glb(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.vertices, np.concatenate([2 * VERTICES, VERTICES]) + np.arange(1, 4))
    np.testing.assert_array_equal(mesh.faces, np.concatenate([FACES, FACES.astype(int) + 4]))


def test_faces_of_a_mirrored_node_look_outwards(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb(content(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}])))
    np.testing.assert_array_equal(read_glb(tmp_path / "a.glb").faces, FACES[:, ::-1])


def test_very_many_small_parts_are_read_soon(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb(content(nodes=[{"mesh": 0}] * 30_000)))
    with in_time(10):
        assert len(read_glb(tmp_path / "a.glb").faces) == 90_000


def test_what_another_program_writes_comes_back(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    box.visual.vertex_colors = [[255, 10 * k, 51, 255] for k in range(8)]
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=trimesh.transformations.rotation_matrix(0.3, [0, 1, 0], [1, 1, 1]))
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    mesh, wanted = read_scene(tmp_path / "a.glb"), scene.to_geometry()
    np.testing.assert_allclose(np.sort(mesh.vertices, 0), np.sort(wanted.vertices, 0), atol=1e-6)
    assert mesh.area == pytest.approx(wanted.area, rel=1e-5)
    assert {tuple(color) for color in mesh.visual.vertex_colors} == {(255, 10 * k, 51, 255) for k in range(8)}


def accessor(number: int, **changes) -> dict:
    rows = content()["accessors"]
    rows[number] |= changes
    return content(accessors=rows)


DAMAGED = {
    "more vertices than bytes": glb(accessor(0, count=10**12)),
    "no vertices": glb(accessor(0, count=-1)),
    "steps of nothing": glb(content(bufferViews=[{"byteLength": 48, "byteStride": 0}] * 2) | accessor(0, count=10**12)),
    "small steps": glb(content(bufferViews=[{"byteLength": 48, "byteStride": 1}, {"byteLength": 18}])),
    "a place before the file": glb(accessor(0, byteOffset=-48)),
    "corners that are not there": glb(content(), VERTICES.tobytes() + (FACES + 9).tobytes() + b"\0\0"),
    "no binary part": glb(content(), b""),
    "no binary part, many vertices": glb(accessor(0, count=1 << 30), b""),
    "half a binary part": glb(content(), VERTICES.tobytes()[:40]),
    "an unknown number": glb(accessor(0, componentType=7)),
    "text for a number": glb(accessor(0, count="4")),
    "a file elsewhere": glb(content(buffers=[{"uri": "/proc/kmsg", "byteLength": 66}]), b""),
    "another buffer": glb(content(bufferViews=[{"buffer": 1, "byteLength": 48}, {"byteLength": 18}])),
    "text for bytes": glb(content(buffers=[{"uri": "data:,AAAA", "byteLength": 66}])),
    "sparse values": glb(accessor(0, sparse={"count": 1 << 30})),
    "too large for single precision": glb(content(nodes=[{"mesh": 0, "scale": [1e300, 1, 1]}])),
    "no view": glb(content(accessors=[{"componentType": 5126, "count": 10**9, "type": "VEC3"}] * 2)),
    "an extension": glb(content(extensionsRequired=["KHR_draco_mesh_compression"])),
    "a circle of nodes": glb(content(nodes=[{"mesh": 0, "children": [1]}, {"children": [1]}])),
    "a node below itself": glb(content(nodes=[{"children": [0]}])),
    "nodes that are not there": glb(content(nodes=[{"children": [7]}])),
    "nodes that double": glb(content(nodes=[*({"children": [k + 1, k + 1]} for k in range(40)), {"mesh": 0}])),
    "a deep chain": glb(content(nodes=[*({"children": [k + 1]} for k in range(5000)), {"mesh": 0}])),
    "not finite": glb(content(nodes=[{"mesh": 0, "scale": [1e308, 1e308, 1e308], "translation": [1e308, 0, 0]}])),
    "JSON that is deep": glb(content(extras=json.loads("[" * 100 + "]" * 100))),
    "another length": glb(content())[:-3],
    "an older version": glb(content()).replace(b"glTF\2", b"glTF\1"),
    "nothing": b"",
    "a packed archive": b"",
    "text": b"solid x\nendsolid x\n",
    "gzip": gzip.compress(glb(content())),
}
packed = io.BytesIO()
with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
    archive.writestr("a.obj", "v 0 0 0\n" * 1_000_000)
DAMAGED["a packed archive"] = packed.getvalue()


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_and_foreign_files_are_refused_soon(damage, suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(DAMAGED[damage])
    with in_time(5), pytest.raises(WearcapError):
        read_scene(path)


@pytest.mark.parametrize("name", ["a.zip", "a.stl", "a.dae", "a.3mf", "a.json", "a"])
def test_other_kinds_are_not_opened(name, tmp_path):
    (tmp_path / name).write_bytes(DAMAGED["a packed archive"])
    with pytest.raises(WearcapError, match="not a scene of a kind that is shown"):
        read_scene(tmp_path / name)


def test_one_mesh_in_very_many_nodes_is_refused(tmp_path):
    vertices = np.random.default_rng(0).random((60_000, 3)).astype(np.float32)
    tree = content(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
        accessors=[{"bufferView": 0, "componentType": 5126, "count": 60_000, "type": "VEC3"}],
        bufferViews=[{"byteLength": 720_000}],
        nodes=[{"mesh": 0}] * 100_000,
    )
    (tmp_path / "a.glb").write_bytes(glb(tree, vertices.tobytes()))
    with in_time(5), pytest.raises(WearcapError, match="vertices and corners"):
        read_glb(tmp_path / "a.glb")


def test_one_mesh_of_very_many_objects_is_read_once(tmp_path):
    vertices = np.random.default_rng(0).random((20_000, 3)).astype(np.float32)
    write_ply(Ply(vertices), tmp_path / "objects/a.ply")
    row = {
        "category": "box",
        "mesh": "objects/a.ply",
        "R_world_object": np.eye(3).tolist(),
        "t_world_object": [0, 0, 0],
    }
    row |= {"freedom": {"kind": "free"}}
    rows = [row | {"name": f"box_{k}"} for k in range(300)]
    (tmp_path / "environment.json").write_text(json.dumps({"schema_version": 1, "objects": rows}))
    objects = read_environment(tmp_path).objects
    assert len({id(item.mesh) for item in objects}) == 1
    rows = [row | {"name": f"box_{k}"} for k in range(200_000)]
    (tmp_path / "environment.json").write_text(json.dumps({"schema_version": 1, "objects": rows[:30_000]}))
    with in_time(5), pytest.raises(WearcapError, match="objects"):
        read_environment(tmp_path)
