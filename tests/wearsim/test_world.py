"""Worlds: floors, clearance, ways that keep off obstacles, doors that one fits through."""

import numpy as np
import pytest

from wearsim.places.flat import build_flat
from wearsim.places.outline import distance_to_convex, points_in_convex, rectangle

SEEDS = range(4)


@pytest.fixture(scope="module", params=SEEDS)
def flat(request):
    return build_flat(np.random.default_rng(request.param), "flat", stairs=bool(request.param % 2))


def test_the_floor_of_a_flight_rises_step_by_step(stairs_flat):
    (flight,) = stairs_flat.places.flights
    along = np.array([np.cos(flight.direction), np.sin(flight.direction)])
    step = np.arange(1, flight.steps)
    middles = np.array(flight.start) + ((step - 0.5) * flight.tread)[:, None] * along
    expected = flight.base_z + step * flight.rise
    np.testing.assert_allclose(stairs_flat.floor_height(middles, expected), expected, atol=1e-6)
    below = stairs_flat.floor_height(middles[8:], np.zeros(len(middles) - 8))
    np.testing.assert_allclose(below, 0.0, atol=1e-6)


def test_no_floor_outside(flat):
    far = np.array([[100.0, 100.0]])
    assert np.isnan(flat.floor_height(far, np.zeros(1))).all()


def test_clearance_is_the_distance_to_the_nearest_thing(flat):
    points = flat.sample_floor(np.random.default_rng(0), 200)
    clearance = flat.navigation.clearance_at(points)
    nearest = np.full(len(points), np.inf)
    for item in flat.objects:
        distance = distance_to_convex(points[:, :2], item.footprint)
        bars = (item.z_range[0] < points[:, 2] + 1.9) & (item.z_range[1] > points[:, 2] + 0.1)
        nearest = np.where(bars, np.minimum(nearest, distance), nearest)
    assert (clearance <= nearest + flat.cell).all()
    inside = flat.objects[0].footprint.mean(0)
    assert flat.navigation.clearance_at(np.array([[*inside, flat.objects[0].z_range[0]]]))[0] < flat.cell


def test_paths_keep_off_obstacles_and_on_the_floor(flat):
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(6):
        start, goal = flat.sample_floor(rng, 2)
        path = flat.plan_path(start, goal, rng)
        if path is None:
            continue
        found += 1
        np.testing.assert_allclose(path[[0, -1], :2], [start[:2], goal[:2]], atol=1e-6)
        gaps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
        assert gaps.max() < 0.15
        assert np.abs(np.diff(path[:, 2])).max() < 0.36
        np.testing.assert_allclose(flat.floor_height(path[:, :2], path[:, 2]), path[:, 2], atol=1e-6)
        own = np.minimum(flat.navigation.clearance_at(start[None]), flat.navigation.clearance_at(goal[None]))[0]
        assert flat.navigation.clearance_at(path).min() > min(0.28, own) - 0.06
    assert found >= 5, "rooms hang together"


def test_no_way_into_the_void(flat):
    start = flat.sample_floor(np.random.default_rng(0), 1)[0]
    assert flat.plan_path(start, np.array([99.0, 99.0, 0.0]), np.random.default_rng(0)) is None


def test_doors_are_wide_enough_and_open(flat):
    assert flat.places.doors
    for door in flat.places.doors:
        assert 0.79 < door.width < 0.96
        middle = np.array([door.position[:3]], dtype=np.float64)
        assert flat.navigation.clearance_at(middle)[0] > 0.28


def test_every_seat_and_target_can_be_reached(flat):
    assert flat.places.seats
    assert flat.places.reach_targets
    rng = np.random.default_rng(0)
    start = flat.sample_floor(rng, 1)[0]
    for point in [seat.standing_point() for seat in flat.places.seats] + [
        np.array(t.stand) for t in flat.places.reach_targets
    ]:
        assert flat.plan_path(start, point, rng) is not None


def test_faces_know_their_object_and_texture(flat):
    count = len(flat.mesh.faces)
    assert flat.face_object.shape == flat.face_texture.shape == (count,)
    assert flat.face_object.max() == len(flat.objects) - 1
    assert flat.face_object.min() == -1
    assert (flat.face_texture >= 0).all()
    assert flat.mesh.faces.max() < len(flat.mesh.vertices)


def test_every_solid_faces_outwards(flat):
    """Signed volumes of the tetrahedra from each object's middle: what is seen is seen from outside."""
    corners = flat.mesh.vertices[flat.mesh.faces].astype(np.float64)
    for item in range(len(flat.objects)):
        a, b, c = np.moveaxis(corners[flat.face_object == item], 1, 0)
        middle = np.concatenate([a, b, c]).mean(0)
        assert np.linalg.det(np.stack([a, b, c], 1) - middle).sum() > 0


def test_a_seed_determines_everything():
    a, b, c = (build_flat(np.random.default_rng(seed), "flat") for seed in (2, 2, 3))
    np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    assert a.mesh.vertices.shape != c.mesh.vertices.shape


def test_points_in_and_distance_to_an_outline():
    outline = rectangle((1.0, 2.0), (2.0, 1.0), np.pi / 2)
    points = np.array([[1.0, 2.0], [1.4, 2.9], [1.6, 2.0], [1.0, 4.0]])
    np.testing.assert_array_equal(points_in_convex(points, outline), [True, True, False, False])
    np.testing.assert_allclose(distance_to_convex(points, outline), [0, 0, 0.1, 1.0], atol=1e-12)
