"""Cutting objects out of a scan, without a browser: what is selected, what an object gets, every step back."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rotation import about_axis
from wearcap.scene.editing import Footprint, ObjectEditing, _floor_below, _usual_freedom, hinge_places, snapped
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.scene.scan import Box, Scan, SlicedCloud, first_hit

FLOOR_M = 0.3


def grid(low, high, spacing: float = 0.02) -> np.ndarray:
    axes = [np.arange(a, b + 1e-9, spacing) for a, b in zip(low, high)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


DOOR = Box((2.0, 1.0, FLOOR_M + 1.0), (0.06, 0.96, 1.96))


@pytest.fixture
def scan() -> Scan:
    """A floor at 0.3 m, a door leaf across y at x = 2, and a crate."""
    floor = grid((0, 0, FLOOR_M), (4, 3, FLOOR_M))
    leaf = grid((1.98, 0.55, FLOOR_M + 0.04), (2.02, 1.45, FLOOR_M + 1.96))
    crate = grid((3.0, 2.0, FLOOR_M + 0.02), (3.4, 2.4, FLOOR_M + 0.4))
    points = np.concatenate([floor, leaf, crate]).astype(np.float32)
    order = np.random.default_rng(0).permutation(len(points))
    return Scan(points[order], np.full((len(points), 3), 128, np.uint8))


def inside(scan: Scan, low, high) -> int:
    return int(((scan.points > low) & (scan.points < high)).all(1).sum())


@given(st.floats(-3.2, 3.2), st.floats(0.1, 2.0), st.integers(0, 2**32 - 1))
def test_a_slice_finds_what_a_search_of_all_points_finds(yaw, length, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (400, 3)).astype(np.float32)
    box = Box(tuple(rng.uniform(-0.5, 0.5, 3)), (length, 0.4, 0.9), yaw)
    cloud = SlicedCloud(points)
    np.testing.assert_array_equal(cloud.in_box(box), np.flatnonzero(box.contains(points)))
    near = np.linalg.norm(points - points[7], axis=1) <= 0.5
    np.testing.assert_array_equal(cloud.in_ball(points[7], 0.5), np.flatnonzero(near))


def test_a_turned_box_is_turned_counter_clockwise():
    box = Box((1.0, 1.0, 0.0), (2.0, 0.2, 1.0), np.pi / 4)
    points = np.array([[1.6, 1.6, 0.0], [1.6, 0.4, 0.0], [1.0, 1.0, 0.6], [1.0, 1.0, 0.5]])
    assert box.contains(points).tolist() == [True, False, False, True]


def test_a_ray_meets_the_front_surface(scan):
    eye, aim = np.array([0.0, 1.0, 1.6]), np.array([2.0, 1.0, 1.2])
    hit = scan.points[first_hit(scan.points, eye, 3 * (aim - eye))]
    assert hit == pytest.approx([1.98, 1.0, 1.204], abs=0.03)
    assert first_hit(scan.points, eye, np.array([-1.0, 0.0, 0.5])) is None
    assert first_hit(scan.points, eye, np.array([0.0, 0.0, 1.0])) is None


def test_a_cut_object_takes_its_points_and_stands_on_the_floor(scan):
    editing = ObjectEditing(scan)
    editing.select_box(DOOR)
    assert len(editing.selected) == inside(scan, (1.9, 0.5, FLOOR_M + 0.02), (2.1, 1.5, 3))
    count = len(editing.selected)
    door = editing.cut("door_1", "door")
    assert len(door.mesh.vertices) == count
    assert door.mesh.faces.shape == (0, 3)
    assert door.t_world_object.tolist() == pytest.approx([2.0, 1.0, FLOOR_M], abs=1e-3)
    taken = np.setdiff1d(np.arange(len(scan.points)), np.flatnonzero(editing.left()))
    np.testing.assert_allclose(door.points_world, scan.points[taken], atol=1e-5)
    assert len(editing.selected) == 0
    assert door.freedom.kind == "hinge"
    assert abs(door.freedom.pivot[1] - 1.0) == pytest.approx(0.45, abs=0.01), "at an end of the leaf"
    editing.select_box(DOOR)
    assert len(editing.selected) == 0, "what an object has cannot be selected again"


def test_brush_paints_and_erases(scan):
    editing = ObjectEditing(scan)
    middle = np.array([3.2, 2.2, FLOOR_M + 0.4])
    editing.select_ball(middle, 0.15)
    painted = len(editing.selected)
    assert painted > 100
    editing.select_ball(middle, 0.08, add=False)
    assert 0 < len(editing.selected) < painted
    editing.clear_selection()
    assert len(editing.selected) == 0


def test_every_step_is_undone_and_a_stroke_at_once(scan):
    editing = ObjectEditing(scan)
    editing.select_box(DOOR)
    selected = editing.selected
    editing.cut("door_1", "door")
    before = editing.revision
    for degrees in range(10, 60, 10):
        freedom = replace(editing.environment.by_name("door_1").freedom, limits=(0.0, np.deg2rad(degrees)))
        editing.set_freedom("door_1", freedom, stroke="limits")
    editing.rename("door_1", "front-door")
    editing.set_kind("front-door", "axis")
    assert editing.environment.by_name("front-door").freedom.kind == "axis"
    editing.delete("front-door")
    assert editing.left().all()
    editing.undo()
    editing.undo()
    assert editing.environment.by_name("front-door").freedom.limits[1] == pytest.approx(np.deg2rad(50))
    editing.undo()
    editing.undo()
    assert editing.revision is before
    editing.undo()
    np.testing.assert_array_equal(editing.selected, selected)
    assert len(editing.environment) == 0
    assert editing.undo()
    assert not editing.undo()


def test_dabs_of_one_stroke_are_one_step(scan):
    editing = ObjectEditing(scan)
    for number, stroke in enumerate(("a", "a", "b", "b")):
        editing.select_ball(np.array([0.5 + 0.3 * number, 1.0, FLOOR_M]), 0.1, stroke=stroke)
    total = len(editing.selected)
    editing.undo()
    assert 0.4 * total < len(editing.selected) < 0.6 * total
    editing.undo()
    assert len(editing.selected) == 0


def test_what_cannot_be_cut_is_reported(scan):
    editing = ObjectEditing(scan)
    with pytest.raises(WearcapError, match="box or the brush"):
        editing.cut("door_1", "door")
    editing.select_box(DOOR)
    for name in ("", "../door", "the door", "-x"):
        with pytest.raises(WearcapError, match="file's name"):
            editing.cut(name, "door")
    editing.cut("door_1", "door")
    assert editing.free_name("door") == "door_2"
    editing.select_box(Box((3.2, 2.2, FLOOR_M + 0.25), (0.5, 0.5, 0.46)))
    with pytest.raises(WearcapError, match="already"):
        editing.cut("Door_1", "box")
    editing.cut("box_1", "box")
    with pytest.raises(WearcapError, match="already"):
        editing.rename("box_1", "door_1")
    with pytest.raises(WearcapError, match="no object 'sofa'"):
        editing.delete("sofa")


def test_saved_objects_are_found_in_the_scan_again(scan):
    first = ObjectEditing(scan)
    first.select_box(DOOR)
    first.cut("door_1", "door")
    again = ObjectEditing(scan, first.environment)
    np.testing.assert_array_equal(again.left(), first.left())
    again.delete("door_1")
    assert again.left().all()


def test_a_mesh_hides_the_points_on_it(scan):
    corners = np.array([[0, y, z] for y in (-0.2, 0.2) for z in (0.02, 0.4)], np.float32)
    face = Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.ones(3, np.float32))
    R = about_axis("z", torch.tensor(0.0))
    crate = SceneObject("crate", "box", face, R, torch.tensor([3.4, 2.2, FLOOR_M]), Freedom("free"))
    hidden = ~ObjectEditing(scan, Environment((crate,))).left()
    side = (scan.points[:, 0] > 3.375) & (scan.points[:, 2] > FLOOR_M + 0.03)
    inner = side & (scan.points[:, 0] < 3.41) & (scan.points[:, 1] > 1.9)
    assert hidden[inner].all()
    assert hidden.sum() < inner.sum() * 2.5


def test_an_environment_of_another_scene_is_refused(scan):
    editing = ObjectEditing(scan)
    editing.select_box(DOOR)
    far = replace(editing.cut("door_1", "door"), t_world_object=torch.tensor([40.0, 1.0, 0.3]))
    with pytest.raises(WearcapError, match="36.0 m outside the scan"):
        ObjectEditing(scan, Environment((far,)))


@given(st.floats(-3.0, 3.0), st.integers(0, 2**32 - 1))
def test_a_footprint_is_the_rectangle_it_came_from(yaw, seed):
    rng = np.random.default_rng(seed)
    local = np.concatenate([rng.uniform(-1, 1, (60, 2)), [[-1, -1], [1, -1], [1, 1], [-1, 1]]]) * [0.6, 0.2]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    points = np.concatenate([local @ turn.T + [3.0, -2.0], rng.uniform(0, 2, (64, 1))], 1)
    plan = Footprint.of(points)
    assert (plan.half_length, plan.half_width) == pytest.approx((0.6, 0.2))
    np.testing.assert_allclose(plan.center, [3.0, -2.0], atol=1e-9)
    assert abs(plan.long @ turn[:, 0]) == pytest.approx(1.0)
    ends = hinge_places(points, 0.5)
    expected = np.array([3.0, -2.0]) + 0.6 * turn[:, 0]
    assert np.linalg.norm(ends[:2, :2] - expected, axis=1).min() < 1e-6
    assert (ends[:, 2] == 0.5).all()


def test_hinges_of_an_odd_shape_stay_within_its_extent():
    apart = np.concatenate([grid((0, 0, 0), (1, 1, 0.1), 0.1), grid((3, 3, 0), (3.1, 3.1, 0.1), 0.1)])
    places = hinge_places(apart, 0.0)
    assert places[:, :2].min() >= 0.0
    assert places[:, :2].max() <= 3.1 + 1e-9


def test_places_snap_within_reach_only():
    places = np.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.1]])
    np.testing.assert_array_equal(snapped(np.array([0.95, 0.05, 2.0]), places, 0.1), [1.0, 0.0, 0.1])
    np.testing.assert_array_equal(snapped(np.array([0.5, 0.05, 2.0]), places, 0.1), [0.5, 0.05, 0.1])


def test_the_floor_is_not_a_stray_point_below_it(scan):
    stray = np.concatenate([scan.points, [[2.0, 1.0, -1.0]]]).astype(np.float32)
    leaf = scan.points[DOOR.contains(scan.points)]
    assert _floor_below(leaf, stray) == pytest.approx(FLOOR_M, abs=1e-3)
    assert _floor_below(leaf, leaf[:0]) == pytest.approx(FLOOR_M + 0.04, abs=1e-3)
    assert _floor_below(leaf, stray[stray[:, 0] > 4]) == pytest.approx(FLOOR_M + 0.04, abs=1e-3)


def test_usual_freedoms(scan):
    leaf = scan.points[DOOR.contains(scan.points)]
    slide = _usual_freedom("axis", leaf, FLOOR_M)
    assert abs(slide.axis[0]) == pytest.approx(1.0), "across the leaf"
    assert _usual_freedom("plane", leaf, FLOOR_M) == Freedom("plane")
    line = np.stack([np.linspace(0, 1, 30), np.zeros(30), np.zeros(30)], 1)
    assert Footprint.of(line).half_length == pytest.approx(0.5)
