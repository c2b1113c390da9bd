"""Scans of simulated worlds: on the surface but for the noise, only what a station sees, coloured as photographed."""

import numpy as np
import pytest

from wearcap.errors import WearcapError
from wearsim.places.outline import points_in_convex
from wearsim.places.site import build_site
from wearsim.rendering.scan import Scanner, place_stations, scan_world
from wearsim.rendering.views import Scenery


@pytest.fixture(scope="module")
def scenery() -> Scenery:
    return Scenery.of(build_site(np.random.default_rng(1), "site", scale=0.5))


@pytest.fixture(scope="module")
def scan(scenery):
    return scan_world(scenery, 0.08, np.random.default_rng(0))


def test_the_floor_is_scanned_where_it_is(scenery, scan):
    hall = next(room for room in scenery.world.places.rooms if room.name == "hall 0")
    middle = hall.polygon.mean(0)
    inner = middle + 0.85 * (hall.polygon - middle)
    over_hall = scan.points[points_in_convex(scan.points[:, :2].astype(float), inner)]
    floor = over_hall[np.abs(over_hall[:, 2]) < 0.03, 2]
    assert len(floor) > 1000
    assert abs(floor.mean()) < 0.0005
    assert 0.0015 < floor.std() < 0.004, "range noise of 3 mm, seen from above"
    assert (over_hall[:, 2] > 2.3).mean() > 0.1, "the ceiling too"


def test_points_are_as_dense_as_asked_near_the_stations(scenery, scan):
    spot = np.array(scenery.world.places.spots[0].position)
    near = (np.linalg.norm(scan.points[:, :2] - spot[:2], axis=1) < 1.5) & (np.abs(scan.points[:, 2]) < 0.03)
    assert near.sum() == pytest.approx(np.pi * 1.5**2 / 0.08**2, rel=0.15)


def test_what_no_station_sees_is_not_scanned(scenery, scan):
    wall = next(item for item in scenery.world.objects if item.kind == "wall")
    inside = wall.footprint.mean(0) + 0.5 * (wall.footprint - wall.footprint.mean(0))
    within = points_in_convex(scan.points[:, :2].astype(float), inside)
    assert ((scan.points[within, 2] > 0.3) & (scan.points[within, 2] < 2.2)).sum() < 3
    assert (scan.points[:, 2] < -0.6).mean() < 0.01, "nothing below the yard's ground but errors"


def test_a_few_points_are_plainly_wrong(scenery):
    scans = [scan_world(scenery, 0.12, np.random.default_rng(0), Scanner(wrong=w, mixed=0.0)) for w in (0.0, 0.02)]
    dense = scan_world(scenery, 0.04, np.random.default_rng(1), Scanner(wrong=0.0, mixed=0.0, noise_m=0.0))
    far = [float((np.isinf(dense.surface.nearest(s.points[::7].astype(np.float64), 0.25)[0])).mean()) for s in scans]
    assert far[0] < 0.005 < far[1] < 0.03


def test_colours_are_there_and_vary(scan):
    assert scan.colors.shape == scan.points.shape
    assert scan.colors.astype(float).std() > 20


def test_a_scan_repeats(scenery):
    one, two = (scan_world(scenery, 0.3, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one.points, two.points)


def test_stations_cover_the_floor(scenery):
    stations = place_stations(scenery.world, 2.0)
    gaps = np.linalg.norm(stations[:, None] - stations[None], axis=-1) + 9 * np.eye(len(stations))
    assert gaps.min() >= 2.0
    free = scenery.world.navigation.node_points
    free = free[scenery.world.navigation.clearance_at(free) > 0.45]
    assert np.linalg.norm(free[:, None] - stations[None], axis=-1).min(1).max() <= 2.0


def test_a_spacing_of_nothing_is_refused(scenery):
    with pytest.raises(WearcapError, match="positive"):
        scan_world(scenery, 0.0, np.random.default_rng(0))
