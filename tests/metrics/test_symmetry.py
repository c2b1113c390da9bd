"""Symmetries of objects are found from their surfaces; a turn by one of them is no error."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from boxes import box_mesh
from wearcap.data.objects import object_cloud
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.metrics.objects import vertex_error_cm
from wearcap.metrics.symmetry import Symmetry, closest_surface_error_cm
from wearsim.places.movables import make_movable

TILTED = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()


def movable(category: str) -> Mesh:
    return make_movable(category, category, np.random.default_rng(0)).object.mesh


def symmetry_of(mesh: Mesh) -> Symmetry:
    return Symmetry.of(mesh, object_cloud(mesh), TriangleIndex.of(mesh))


@pytest.mark.parametrize(
    ("size", "R", "turns"),
    [
        ((0.3, 0.4, 0.6), np.eye(3), 4),
        ((0.3, 0.4, 0.6), TILTED, 4),
        ((0.3, 0.3, 0.6), np.eye(3), 8),
        ((0.4, 0.4, 0.4), np.eye(3), 24),
    ],
    ids=["box", "tilted box", "square", "cube"],
)
def test_boxes_have_the_turns_of_their_sides(size, R, turns):
    mesh = box_mesh((0.1, 0.0, 0.0), (0.1 + size[0], size[1], size[2]))
    found = symmetry_of(replace(mesh, vertices=(mesh.vertices @ R.T).astype(np.float32)))
    different: list[torch.Tensor] = []
    for turn in found.turns:
        if all(rotation.geodesic(turn, other) > 0.1 for other in different):
            different.append(turn)
    assert len(different) == turns
    assert not len(found.axes)


def test_household_objects():
    """A suitcase has two sides, a chair one, a bottle is round and a ball is round all over."""
    counts = {name: symmetry_of(movable(name)) for name in ("suitcase", "table", "chair", "bottle", "ball")}
    angles = {name: rotation.geodesic(s.turns, torch.eye(3).double().expand_as(s.turns)) for name, s in counts.items()}
    for name in ("suitcase", "table"):
        assert sorted(angles[name].rad2deg().round().unique().tolist()) == [0, 180], name
    assert angles["chair"].max() < 1e-3
    assert [len(counts[name].axes) for name in ("suitcase", "chair", "bottle", "ball")] == [0, 0, 1, 3]
    assert counts["bottle"].axes[0].abs().tolist() == pytest.approx([0, 0, 1], abs=0.05)


def about(axis: str, degrees: float) -> Rigid:
    R = rotation.about_axis(axis, torch.tensor([degrees]).deg2rad().double())
    return Rigid(R, torch.zeros(1, 3, dtype=torch.float64))


def test_rotations_are_measured_modulo_the_symmetry():
    level = about("z", 0.0)
    turns = {
        "suitcase": (("z", 180.0, 0.0), ("z", 171.0, 9.0), ("z", 71.0, 71.0), ("z", 109.0, 71.0), ("x", 40.0, 40.0)),
        "bottle": (("z", 123.0, 0.0), ("x", 35.0, 35.0)),
        "ball": (("z", 123.0, 0.0), ("x", 35.0, 0.0)),
        "chair": (("z", 180.0, 180.0), ("z", 71.0, 71.0)),
    }
    for name, rows in turns.items():
        symmetry = symmetry_of(movable(name))
        for axis, degrees, expected in rows:
            found = symmetry.rotation_difference_deg(about(axis, degrees), level).item()
            assert found == pytest.approx(expected, abs=1.0), (name, axis, degrees)


def test_vertices_are_measured_from_the_pose_that_looks_the_same():
    """Turned about its own middle by its symmetry an object is where it was; moved besides, it is as far off as it was moved;
    a chair has no second side."""
    random = torch.Generator().manual_seed(0)
    for name, axis, degrees in (("suitcase", "z", 180.0), ("bottle", "z", 123.0), ("ball", "x", 71.0)):
        mesh = movable(name)
        mesh = replace(mesh, vertices=mesh.vertices + np.float32([0.1, -0.2, 0.05]))
        symmetry, cloud = symmetry_of(mesh), object_cloud(mesh)
        center = symmetry.center
        place = Rigid(
            rotation.exp(torch.randn(4, 3, generator=random).double()), torch.randn(4, 3, generator=random).double()
        )
        turn = about(axis, degrees).R[0]
        turned = place @ Rigid(turn, center - turn @ center)
        allowed = 2 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        assert vertex_error_cm(turned, place, cloud.double()).min() > 5, name
        assert symmetry.vertex_error_cm(turned, place, cloud).max() < allowed, name
        moved = Rigid(turned.R, turned.t + torch.tensor([0.3, 0.0, 0.0]))
        assert symmetry.vertex_error_cm(moved, place, cloud).mean().item() == pytest.approx(30, abs=allowed), name
        back = symmetry.nearest(turned, place.R)
        assert rotation.geodesic(back.R, place.R).max() < 0.1 or len(symmetry.axes) > 1, name
    chair, level = movable("chair"), about("z", 0.0)
    cloud, turned = object_cloud(chair), about("z", 180.0)
    found = symmetry_of(chair).vertex_error_cm(turned, level, cloud).item()
    assert found == pytest.approx(vertex_error_cm(turned, level, cloud.double()).item())


def test_the_closest_surface_does_not_know_the_sides_of_a_suitcase():
    mesh = movable("suitcase")
    cloud, surface = object_cloud(mesh), TriangleIndex.of(mesh)
    middle = (cloud.max(0).values + cloud.min(0).values) / 2
    cloud = cloud - middle
    level, turned = about("z", 0.0), about("z", 180.0)
    assert closest_surface_error_cm(turned, level, cloud, middle, surface).item() < 0.05
    assert vertex_error_cm(turned, level, cloud.double()).item() > 20
    lifted = Rigid(level.R, level.t + torch.tensor([0.0, 0.0, 1.0]))
    above = closest_surface_error_cm(lifted, level, cloud, middle, surface).item()
    assert 50 < above < 100, "a metre up, less the suitcase's height where it is near"
