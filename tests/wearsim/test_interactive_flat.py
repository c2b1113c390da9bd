"""Interactive flats: what can be moved is apart from what cannot, and moves within its limits."""

from collections import Counter

import numpy as np
import pytest
import torch

from wearsim.places.interactive_flat import FEWEST, House, build_interactive_flat
from wearsim.places.outline import distance_to_convex

SEEDS = range(4)


@pytest.fixture(scope="module")
def flats():
    return [build_interactive_flat(np.random.default_rng(seed), f"flat {seed}") for seed in SEEDS]


def test_every_flat_has_enough_to_move(flats):
    for flat in flats:
        kinds = Counter(item.category for item in (*flat.movables, *flat.openables))
        assert kinds.total() == len(flat.environment) >= 10
        assert all(kinds[kind] >= least for kind, least in FEWEST.items()), kinds
        assert not {"sofa", "table", "chair", "armchair"} & {item.kind for item in flat.static.objects}


def test_doors_and_drawers_have_the_sizes_of_real_ones(flats):
    for item in (item for flat in flats for item in flat.openables):
        width = item.outline[:, 0].max()
        handle = item.handle(0, np.array(item.closed))
        if item.category == "door":
            assert 0.76 < width < 0.96
            assert 1.0 <= handle[2] <= 1.05
            assert np.deg2rad(74) < item.openness(item.opened) < np.deg2rad(101)
        elif item.category == "window":
            assert 0.4 < width <= 0.9
            assert 1.2 <= handle[2] <= 1.5
        elif item.category == "drawer":
            assert 0.29 < item.openness(item.opened) <= 0.5
            assert 0.35 < handle[2] < 1.15
        limits = item.object.freedom.limits
        assert limits[0] - 1e-9 <= min(item.closed, item.opened)
        assert max(item.closed, item.opened) <= limits[1] + 1e-9


def test_a_closed_leaf_fills_its_gap_and_an_open_one_clears_it(flats):
    for flat in flats:
        for door in (item for item in flat.openables if item.category == "door"):
            gap = min(
                flat.static.places.doors,
                key=lambda d: np.linalg.norm(door.footprint(door.closed).mean(0) - d.position[:2]),
            )
            middle = np.array(gap.position[:2])
            assert distance_to_convex(middle, door.footprint(door.closed)) < 0.08
            opened = door.closed + door.opening_sign * np.deg2rad(75)
            assert distance_to_convex(middle, door.footprint(opened)) > 0.3
            pose = door.object.T_world_object
            start = door.pose(0.0)
            assert torch.allclose(start.R.float(), pose.R, atol=1e-6)
            assert torch.allclose(start.t.float(), pose.t, atol=1e-6)


def test_things_stand_apart_and_leave_the_doors_their_sweep(flats):
    for flat in flats:
        house = House(flat)
        names = {movable.name for movable in flat.movables}
        movables = [item for item in house.obstacles() if item.name in names]
        for door in (item for item in flat.openables if item.category == "door"):
            for value in np.linspace(door.closed, door.opened, 7):
                tip = door.footprint(value)[1:3]
                assert min(distance_to_convex(tip, movable.footprint).min() for movable in movables) > 0.0


def test_closed_doors_bar_the_way_and_open_ones_do_not(flats):
    for flat in flats:
        house = House(flat)
        point = flat.static.sample_floor(np.random.default_rng(0), 1)[0]
        doors = [item for item in flat.openables if item.category == "door"]
        cells = {}
        for name, value in (("shut", "closed"), ("open", "opened")):
            house.values |= {door.name: getattr(door, value) for door in doors}
            cells[name] = house.world(point).navigation.walkable.sum()
        assert cells["shut"] < 0.75 * cells["open"]


def test_a_flat_is_its_seed(flats):
    again = build_interactive_flat(np.random.default_rng(SEEDS[1]), "flat 1")
    assert np.array_equal(again.world.mesh.vertices, flats[1].world.mesh.vertices)
    assert not np.array_equal(again.world.mesh.vertices.shape, flats[2].world.mesh.vertices.shape)
    for one, two in zip(again.environment.objects, flats[1].environment.objects):
        assert one.name == two.name
        assert torch.equal(one.t_world_object, two.t_world_object)
