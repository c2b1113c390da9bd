"""Seeded flats: rooms on one or both sides of a hallway, furnished; some with stairs to a second storey."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from wearsim.places.builder import WorldBuilder, hue
from wearsim.places.furniture import ROOM_KINDS, Plan, wood
from wearsim.places.outline import Box, inset, middle_and_size, rectangle
from wearsim.places.walls import HEIGHT, THICKNESS, Wall, before_gap, build_flight, build_railing
from wearsim.places.world import Flight, World

STAIR_SHARE = 0.35
"""Share of flats with a second storey."""
NARROWEST_ROOM_M = 2.9
INSET_M = THICKNESS / 2 + 0.01
"""Distance of furniture from the middle of a wall."""
Furnish = Callable[[Plan, str, np.random.Generator], None]
"""Furnishes a room by its kind (`ROOM_KINDS`)."""


@dataclass(frozen=True)
class _Layout:
    """Outlines of one storey (m): side A below the hallway (y up to `hall[0]`), side B above it."""

    width: float
    hall: tuple[float, float]
    depth: float
    """Depth of the whole storey; equals hall[1] where side B has no rooms."""
    side_a: tuple[Box, ...]
    side_b: tuple[Box, ...]

    @classmethod
    def drawn(cls, rng: np.random.Generator, with_stairs: bool) -> "_Layout":
        width, depth_a = rng.uniform(8.0, 11.5), rng.uniform(3.3, 4.6)
        fit = int(width / NARROWEST_ROOM_M)
        hall = rng.uniform(2.45, 2.75) if with_stairs else rng.uniform(1.3, 1.8)
        side_a = _split(rng, width, int(rng.integers(2, fit + 1)), 0.0, depth_a)
        count_b = 0 if with_stairs else int(rng.integers(0, min(fit, 5 - len(side_a)) + 1))
        depth_b = rng.uniform(3.0, 4.2) if count_b else 0.0
        side_b = _split(rng, width, count_b, depth_a + hall, depth_a + hall + depth_b)
        return cls(width, (depth_a, depth_a + hall), depth_a + hall + depth_b, side_a, side_b)

    def walls(self, z: float, rng: np.random.Generator) -> list[Wall]:
        """Outer walls with windows, walls between rooms, and the hallway's walls with a door to every room."""
        width, depth = self.width, self.depth
        south, north = (
            Wall((0.0, y), (width, y), z, windows=[((b[0] + b[2]) / 2, float(rng.uniform(0.9, 1.5))) for b in side])
            for y, side in ((0.0, self.side_a), (depth, self.side_b))
        )
        west = Wall((0.0, 0.0), (0.0, depth), z)
        east = Wall((width, 0.0), (width, depth), z, windows=[(sum(self.hall) / 2, 0.7)])
        walls = [south, north, west, east]
        drawn_door = lambda low, high: (float(rng.uniform(low, high)), float(rng.uniform(0.80, 0.95)))  # noqa: E731
        for side, y in ((self.side_a, self.hall[0]), (self.side_b, self.hall[1])):
            if not side:
                continue
            walls.append(Wall((0, y), (width, y), z, doors=[drawn_door(b[0] + 0.75, b[2] - 0.75) for b in side]))
            for box in side[1:]:
                between = Wall((box[0], box[1]), (box[0], box[3]), z)
                if rng.uniform() < 0.35:
                    between.doors.append(drawn_door(0.75, between.length - 0.75))
                walls.append(between)
        return walls


def build_flat(rng: np.random.Generator, name: str, stairs: bool | None = None) -> World:
    """A flat of 2–5 rooms (per storey at most) with doors of 0.80–0.95 m; `stairs` None leaves it to chance."""
    builder = WorldBuilder.drawn(name, rng)
    lay_out(builder, rng, bool(rng.uniform() < STAIR_SHARE) if stairs is None else stairs)
    return builder.finish()


def lay_out(builder: WorldBuilder, rng: np.random.Generator, stairs: bool, furnish: Furnish = Plan.furnish) -> None:
    """Build walls and floors, and furnish each room by its kind."""
    layout = _Layout.drawn(rng, stairs)
    hall = (0.0, layout.hall[0], layout.width, layout.hall[1])
    storeys = [(0.0, [hall])]
    if stairs:
        # a flight along the hallway's outer wall, and the hole above it
        steps, rise, tread, width = 15, rng.uniform(0.172, 0.18), rng.uniform(0.28, 0.29), rng.uniform(0.92, 1.0)
        run = (steps - 1) * tread
        low = rng.uniform(1.3, layout.width - run - 1.3)
        y = layout.hall[1] - THICKNESS / 2 - width / 2 - 0.01
        rightwards = bool(rng.uniform() < 0.5)
        foot, direction = (low, 0.0) if rightwards else (low + run, np.pi)
        flight = Flight((foot, y), direction, steps, rise, tread, width, 0.0)
        build_flight(builder, flight, (-1,) if rightwards else (1,))
        rail_y = y - width / 2 - 0.03
        for start, end in (
            ((low, rail_y), (low + run, rail_y)),
            ((foot, rail_y), (foot, layout.hall[1] - THICKNESS / 2)),
        ):
            build_railing(builder, start, end, flight.top_z)
        hole = (low, y - width / 2 - 0.06, low + run, layout.hall[1])
        # The upper hallway: a strip past the hole, and the floor in front of it and behind it.
        past = (hall[0], hall[1], hall[2], hole[1])
        storeys.append(
            (flight.top_z, [past, (hall[0], hole[1], hole[0], hall[3]), (hole[2], hole[1], hall[2], hall[3])])
        )
    rooms = layout.side_a + layout.side_b
    for level, (z, floors) in enumerate(storeys):
        slab, wall_color = (0.05 if level == 0 else z - HEIGHT), hue(rng, (0.0, 0.15))
        for outline in floors:
            builder.add_slab("floor", outline, z, slab, wood(rng), 1.5, level=level)
        for wall in layout.walls(z, rng):
            wall.build(builder, wall_color, rng)
        kept_free = [before_gap(builder, door) for door in builder.places.doors if abs(door.position[2] - z) < 0.1]
        kinds = rng.permutation([*ROOM_KINDS, *ROOM_KINDS])[: len(rooms)]
        for number, (outline, kind) in enumerate(zip(rooms, kinds)):
            builder.add_slab("floor", outline, z, slab, wood(rng), 1.5, level=level)
            builder.add_room(f"{kind} {level}.{number}", rectangle(*middle_and_size(outline)), z)
            furnish(Plan(builder, inset(outline, INSET_M), z, list(kept_free)), str(kind), rng)
        builder.add_room(f"hallway {level}", rectangle(*middle_and_size(floors[0])), z)


def _split(rng: np.random.Generator, width: float, count: int, low: float, high: float) -> tuple[Box, ...]:
    """`count` rooms side by side, none narrower than `NARROWEST_ROOM_M`."""
    if count == 0:
        return ()
    spare = (width - count * NARROWEST_ROOM_M) * rng.dirichlet(np.full(count, 2.0))
    edges = np.concatenate([[0.0], (NARROWEST_ROOM_M + spare).cumsum()])
    return tuple((float(a), low, float(b), high) for a, b in pairwise(edges))
