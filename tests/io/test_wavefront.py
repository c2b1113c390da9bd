"""Wavefront .obj: what exporters write, and hostile files."""

import numpy as np
import pytest
from hypothesis import given
from one_object_files import CORNERS, obj_text

from boxes import BOX_FACES
from hostile import fuzz, mutated
from wearcap.errors import WearcapError
from wearcap.io.formats.wavefront import read_obj


def test_a_box(tmp_path):
    (tmp_path / "a.obj").write_text(obj_text(1.0))
    mesh = read_obj(tmp_path / "a.obj")
    np.testing.assert_allclose(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, BOX_FACES)


def test_colours_texture_polygons_and_indices_from_the_end(tmp_path):
    text = "o a\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nvt 0 0\nvn 0 0 1\nv 1 1 0\nv 0 1 0\ns 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf -4 -3 -2\nl 1 2\n"
    (tmp_path / "a.obj").write_text(text)
    mesh = read_obj(tmp_path / "a.obj")
    assert mesh.vertices.shape == (4, 3)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_faces_may_stand_before_their_vertices_and_be_absent(tmp_path):
    (tmp_path / "a.obj").write_text("f 1 2 3\nv 0 0 0\nv 1 0 0\nv 0 1 0\n")
    assert read_obj(tmp_path / "a.obj").faces.tolist() == [[0, 1, 2]]
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    assert not len(read_obj(tmp_path / "a.obj").faces)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0\n", "line 1: not a readable vertex"),
        ("v 0 0 inf\n", "no three finite numbers"),
        ("v 0 0 1e39\n", "no three finite numbers"),
        ("v 0 0 x\n", "line 1: not a readable vertex"),
        ("v 0 0 0\nf 1 1\n", "line 2: not a readable face .2 corners"),
        ("v 0 0 0\nf 1 2 3\n", "names vertex 3, there are 1"),
        ("v 0 0 0\nf 0 1 1\n", "not a readable face"),
        ("v 0 0 0\nf -2 1 1\n", "not a readable face"),
        ("v 0 0 0\nf a b c\n", "not a readable face"),
        ("v 0 0 0\nf 1 1 99999999999999999999999\n", "not a readable face"),
        ("f 1 2 3\n", "no vertices"),
        ("a\0b", "binary"),
        ("", "empty"),
    ],
)
def test_hostile_files_are_named(tmp_path, text, message):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(WearcapError, match=message) as raised:
        read_obj(tmp_path / "a.obj")
    assert "a.obj" in str(raised.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(WearcapError, match="a.obj"):
        read_obj(tmp_path / "a.obj")


@fuzz
@given(text=mutated(obj_text(1.0)))
def test_damaged_files_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "fuzz.obj"
    path.write_text(text, encoding="utf-8")
    try:
        mesh = read_obj(path)
    except WearcapError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert not len(mesh.faces) or mesh.faces.max() < len(mesh.vertices)
