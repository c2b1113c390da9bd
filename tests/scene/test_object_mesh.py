"""Meshes of objects: centring, and each fault with its own message."""

import copy

import numpy as np
import pytest

from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.scene.objects import centered, check_object_mesh

CORNERS = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.15, 0.15) for z in (-0.1, 0.1)], np.float32)
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]], np.int32)
NONE = np.zeros((0, 3), np.int32)


def mesh(vertices=CORNERS, faces=FACES) -> Mesh:
    return Mesh(vertices.astype(np.float32), faces, np.ones(3, np.float32))


def spoiled(value: float) -> np.ndarray:
    vertices = CORNERS.copy()
    vertices[5, 1] = value
    return vertices


FAULTS = {
    "NaN": (mesh(spoiled(np.nan)), "1 vertices of the object's mesh are NaN or infinite, the first is 5"),
    "infinite": (mesh(spoiled(np.inf)), "NaN or infinite"),
    "no faces": (mesh(faces=NONE), "the object's mesh has no faces"),
    "no vertices": (mesh(CORNERS[:0], NONE), "the object's mesh has no vertices"),
    "other faces": (mesh(faces=FACES + 5), "names vertex 12, there are 8"),
    "millimetres": (
        mesh(CORNERS * 1000),
        "400 m long. Expected 0.01 to 5 m. It looks like millimetres: divide by 1000",
    ),
    "a house": (mesh(CORNERS * 1e5), "4e[+]04 m long.*Bring it to metres"),
    "a crumb": (mesh(CORNERS / 100), "0.004 m long.*Bring it to metres"),
    "off centre": (mesh(CORNERS + 1), "not centred: its origin lies 1.4. m outside"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(fault):
    spoilt, message = FAULTS[fault]
    with pytest.raises(WearcapError, match=message) as inputs:
        check_object_mesh(spoilt, "some/box.ply")
    assert str(inputs.value).startswith("some/box.ply: ")
    assert str(copy.copy(inputs.value)) == str(inputs.value)


def test_what_is_sound_passes():
    check_object_mesh(mesh(), "box.ply")
    check_object_mesh(mesh(CORNERS + np.array([0.39, 0, 0])), "an origin just beside the box is allowed")


def test_centring_moves_the_mean_of_the_vertices_to_the_origin():
    moved, center = centered(mesh(CORNERS + np.array([12.0, -7.0, 0.4])))
    np.testing.assert_allclose(center, [12.0, -7.0, 0.4], atol=1e-5)
    np.testing.assert_allclose(moved.vertices, CORNERS, atol=1e-5)
    check_object_mesh(moved, "box.ply")
    with pytest.raises(WearcapError, match="without vertices"):
        centered(mesh(CORNERS[:0], NONE))
