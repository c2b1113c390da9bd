"""Hand-held objects on the free floor of an interactive flat."""

import numpy as np

from wearcap.simulation.handling.house import House
from wearcap.simulation.handling.rearranging import APART_M, apart, outlines
from wearcap.simulation.places.handhelds import MAKERS
from wearcap.simulation.places.interactive_flat import InteractiveFlat, obstacle
from wearcap.simulation.places.movables import Movable, make_movable
from wearcap.simulation.places.openables import at
from wearcap.simulation.places.outline import rectangle

TWICE = 0.4
"""Probability of two objects of a kind."""
TRIES = 60
OPEN_SHARE, WIDE = 0.75, np.deg2rad(66.0)
"""Share of the shut doors that are opened; least angle to which they are."""
REACHABLE_SHARE = 0.96
"""Share of the floor that must stay reachable when an object has been put there."""


def with_handhelds(flat: InteractiveFlat, rng: np.random.Generator) -> InteractiveFlat | None:
    """The flat with most doors open and one or two of each hand-held kind at reachable places.

    They are clear of doors, drawers and walkers. None where a kind finds no place.
    """
    openables = tuple(
        at(item, item.opening_sign * float(rng.uniform(WIDE, item.openness(item.opened))))
        if item.category == "door" and item.blocks(0.0) and rng.random() < OPEN_SHARE
        else item
        for item in flat.openables
    )
    flat = InteractiveFlat(flat.static, flat.movables, openables)
    names = [f"{category}_{number}" for category in MAKERS for number in range(1, 2 + int(rng.random() < TWICE))]
    for name in names:
        movable = make_movable(name.rpartition("_")[0], name, rng)
        if (placed := _placed(flat, movable, rng)) is not None:
            flat = InteractiveFlat(flat.static, (*flat.movables, placed), openables)
    kinds = {movable.category for movable in flat.movables}
    return flat if kinds.issuperset(MAKERS) else None


def _placed(flat: InteractiveFlat, movable: Movable, rng: np.random.Generator) -> Movable | None:
    """The object at a free place of the floor; None where none was found."""
    house, navigation = House(flat), flat.static.navigation
    standing = house.obstacles()
    solid = [item.footprint for item in (*flat.static.objects, *standing) if item.z_range[0] < 1.0]
    zones = house.kept_free()
    rooms = [navigation.barred(standing, point) for point in flat.static.sample_floor(rng, 6)]
    points = max(rooms, key=lambda grid: int(grid.walkable.sum())).node_points
    outline = rectangle((0.0, 0.0), (2 * movable.half_size[0], 2 * movable.half_size[1]))
    for _ in range(TRIES):
        x, y, z = points[rng.integers(len(points))]
        x, y, heading = (float(v) for v in (*rng.normal((x, y), 0.15), rng.uniform(-np.pi, np.pi)))
        if not apart(outlines(outline, np.array([[x, y, heading]])), [*solid, *zones], APART_M):
            continue
        placed = movable.placed(x, y, heading, float(z))
        for around in points[rng.integers(len(points), size=2)]:
            left = navigation.barred((*standing, obstacle(placed, None)), around).walkable.sum()
            if left > REACHABLE_SHARE * len(points):
                return placed
    return None
