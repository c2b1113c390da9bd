"""Large sites: big enough, in one piece, and with a capture spot that is free."""

import numpy as np
import pytest

from wearsim.places.outline import points_in_convex
from wearsim.places.site import build_site
from wearsim.places.world import World


@pytest.fixture(scope="module", params=(0, 3))
def site(request) -> World:
    return build_site(np.random.default_rng(request.param), "site")


def test_a_site_is_large_and_hangs_together(site):
    grid = site.navigation
    assert 600 < grid.walkable.sum() * grid.cell**2 < 1000
    assert sum(room.open_air for room in site.places.rooms) == 2
    assert len(site.places.rooms) >= 9
    for room in site.places.rooms:
        inside = points_in_convex(grid.node_points[:, :2], room.polygon)
        assert inside.sum() * grid.cell**2 > 8.0, room.name


def test_the_yard_lies_lower_and_is_reached_by_stairs_and_ramp(site):
    yard = next(room for room in site.places.rooms if room.name == "yard")
    assert yard.z < -0.25
    assert {surface.kind for surface in site.surfaces} == {"floor", "ramp", "stairs_step"}
    middle = site.places.spots[0].position
    points = site.navigation.node_points
    there = points[points_in_convex(points[:, :2], yard.polygon)]
    path = site.plan_path(np.array(middle), there[len(there) // 2], np.random.default_rng(0))
    assert path is not None
    assert np.abs(np.diff(path[:, 2])).max() < 0.18, "one step at a time"


def test_the_capture_spot_is_free_and_beside_a_table(site):
    spot = site.places.spots[0]
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.4, 0.4, 9) * spot.size]), -1).reshape(-1, 2)
    points = np.concatenate([grid + np.array(spot.position[:2]), np.full((len(grid), 1), spot.position[2])], 1)
    inside = np.linalg.norm(grid, axis=1) < spot.size / 2 - 0.3
    assert (site.navigation.clearance_at(points[inside]) > 0.2).all()
    ahead = np.array([np.cos(spot.heading), np.sin(spot.heading)])
    table = min(
        (item for item in site.objects if item.kind == "table"),
        key=lambda item: np.linalg.norm(np.array(item.position[:2]) - spot.position[:2]),
    )
    edge = ((table.footprint - np.array(spot.position[:2])) @ ahead).min()
    assert edge == pytest.approx(spot.table_m, abs=1e-6)
    assert table.z_range[1] - table.z_range[0] >= spot.table_z - 1e-9
