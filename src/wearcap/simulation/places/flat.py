"""Seeded flats: rooms on one or both sides of a hallway, furnished; some with stairs to a second storey."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from wearcap.simulation.places.builder import WorldBuilder, hue
from wearcap.simulation.places.furnish import ROOM_KINDS, Box, Plan
from wearcap.simulation.places.furniture import wood
from wearcap.simulation.places.outline import rectangle
from wearcap.simulation.places.walls import HEIGHT, THICKNESS, Wall, build_flight, build_railing, build_wall
from wearcap.simulation.places.world import Room, World

STAIR_SHARE = 0.35
"""Share of flats with a second storey."""
NARROWEST_ROOM_M = 2.9


@dataclass(frozen=True)
class Layout:
    """Outlines of one storey (m): side A below the hallway (y up to `hall[0]`), side B above it."""

    width: float
    hall: tuple[float, float]
    depth: float
    """Depth of the whole storey; equals hall[1] where side B has no rooms."""
    side_a: tuple[Box, ...]
    side_b: tuple[Box, ...]

    @property
    def rooms(self) -> tuple[Box, ...]:
        return self.side_a + self.side_b


def build_flat(rng: np.random.Generator, name: str, stairs: bool | None = None) -> World:
    """A flat of 2–5 rooms (per storey at most) with doors of 0.80–0.95 m; `stairs` None leaves it to chance."""
    builder = WorldBuilder(name, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-5.0, 5.0, 2).tolist()))
    lay_out(builder, rng, bool(rng.uniform() < STAIR_SHARE) if stairs is None else stairs)
    return builder.finish(cell=0.1)


def lay_out(
    builder: WorldBuilder,
    rng: np.random.Generator,
    stairs: bool,
    furnish: Callable[[Plan, str, np.random.Generator], None] = Plan.furnish,
) -> None:
    """Build walls and floors, and furnish each room by its kind (`ROOM_KINDS`)."""
    layout = _draw_layout(rng, stairs)
    hall = (0.0, layout.hall[0], layout.width, layout.hall[1])
    if stairs:
        hole, upper_z = _build_stairs(builder, layout, rng)
        _build_storey(builder, layout, 0, 0.0, [hall], rng, furnish)
        _build_storey(builder, layout, 1, upper_z, _around(hall, hole), rng, furnish)
    else:
        _build_storey(builder, layout, 0, 0.0, [hall], rng, furnish)


def _draw_layout(rng: np.random.Generator, with_stairs: bool) -> Layout:
    width, depth_a = rng.uniform(8.0, 11.5), rng.uniform(3.3, 4.6)
    fit = int(width / NARROWEST_ROOM_M)
    hall = rng.uniform(2.45, 2.75) if with_stairs else rng.uniform(1.3, 1.8)
    side_a = _split(rng, width, int(rng.integers(2, fit + 1)), 0.0, depth_a)
    count_b = 0 if with_stairs else int(rng.integers(0, min(fit, 5 - len(side_a)) + 1))
    depth_b = rng.uniform(3.0, 4.2) if count_b else 0.0
    side_b = _split(rng, width, count_b, depth_a + hall, depth_a + hall + depth_b)
    return Layout(width, (depth_a, depth_a + hall), depth_a + hall + depth_b, side_a, side_b)


def _split(rng: np.random.Generator, width: float, count: int, low: float, high: float) -> tuple[Box, ...]:
    """`count` rooms side by side, none narrower than `NARROWEST_ROOM_M`."""
    if count == 0:
        return ()
    spare = (width - count * NARROWEST_ROOM_M) * rng.dirichlet(np.full(count, 2.0))
    edges = np.concatenate([[0.0], (NARROWEST_ROOM_M + spare).cumsum()])
    return tuple((float(a), low, float(b), high) for a, b in pairwise(edges))


def _build_storey(
    builder: WorldBuilder,
    layout: Layout,
    level: int,
    z: float,
    hall: list[Box],
    rng: np.random.Generator,
    furnish: Callable[[Plan, str, np.random.Generator], None],
) -> None:
    slab, wall_color = (0.05 if level == 0 else z - HEIGHT), hue(rng, (0.0, 0.15))
    for outline in hall:
        _floor(builder, outline, z, level, slab, wood(rng))
    for wall in _walls(layout, z, rng):
        build_wall(builder, wall, wall_color, rng)
    doors = [door for door in builder.doors if abs(door.position[2] - z) < 0.1]
    kept_free = [before_door(builder, door) for door in doors]
    kinds = rng.permutation([*ROOM_KINDS, *ROOM_KINDS])[: len(layout.rooms)]
    for number, (outline, kind) in enumerate(zip(layout.rooms, kinds)):
        _floor(builder, outline, z, level, slab, wood(rng))
        corners = rectangle(_middle(outline), (outline[2] - outline[0], outline[3] - outline[1]))
        builder.rooms.append(Room(f"{kind} {level}.{number}", builder.to_world(corners), z))
        inset = THICKNESS / 2 + 0.01
        inner = (outline[0] + inset, outline[1] + inset, outline[2] - inset, outline[3] - inset)
        furnish(Plan(builder, inner, z, list(kept_free)), str(kind), rng)
    corners = rectangle(_middle(hall[0]), (hall[0][2] - hall[0][0], hall[0][3] - hall[0][1]))
    builder.rooms.append(Room(f"hallway {level}", builder.to_world(corners), z))


def _walls(layout: Layout, z: float, rng: np.random.Generator) -> list[Wall]:
    """Outer walls with windows, walls between rooms, and the hallway's walls with a door to every room."""
    width, depth = layout.width, layout.depth
    window = lambda box: ((box[0] + box[2]) / 2, float(rng.uniform(0.9, 1.5)))  # noqa: E731
    south = Wall((0.0, 0.0), (width, 0.0), z, windows=[window(box) for box in layout.side_a])
    north = Wall((0.0, depth), (width, depth), z, windows=[window(box) for box in layout.side_b])
    west = Wall((0.0, 0.0), (0.0, depth), z)
    east = Wall((width, 0.0), (width, depth), z, windows=[(sum(layout.hall) / 2, 0.7)])
    walls = [south, north, west, east]
    for side, y in ((layout.side_a, layout.hall[0]), (layout.side_b, layout.hall[1])):
        if not side:
            continue
        doors = [(float(rng.uniform(box[0] + 0.75, box[2] - 0.75)), _door_width(rng)) for box in side]
        walls.append(Wall((0, y), (width, y), z, doors=doors))
        for box in side[1:]:
            between = Wall((box[0], box[1]), (box[0], box[3]), z)
            if rng.uniform() < 0.35:
                between.doors.append((float(rng.uniform(0.75, between.length - 0.75)), _door_width(rng)))
            walls.append(between)
    return walls


def _door_width(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.80, 0.95))


def _build_stairs(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> tuple[Box, float]:
    """A flight along the hallway's outer wall; returns the hole above it and the height it leads to."""
    steps, rise, tread, width = 15, rng.uniform(0.172, 0.18), rng.uniform(0.28, 0.29), rng.uniform(0.92, 1.0)
    run = (steps - 1) * tread
    low = rng.uniform(1.3, layout.width - run - 1.3)
    y = layout.hall[1] - THICKNESS / 2 - width / 2 - 0.01
    rightwards = bool(rng.uniform() < 0.5)
    start, direction = ((low, y), 0.0) if rightwards else ((low + run, y), np.pi)
    flight = build_flight(builder, start, direction, steps, rise, tread, width, 0.0, (-1,) if rightwards else (1,))
    hole = (low, y - width / 2 - 0.06, low + run, layout.hall[1])
    rail_y = y - width / 2 - 0.03
    build_railing(builder, (low, rail_y), (low + run, rail_y), flight.top_z)
    foot = low if rightwards else low + run
    build_railing(builder, (foot, rail_y), (foot, layout.hall[1] - THICKNESS / 2), flight.top_z)
    return hole, flight.top_z


def _around(hall: Box, hole: Box) -> list[Box]:
    """The upper hallway: a strip past the hole, and the floor in front of it and behind it."""
    return [
        (hall[0], hall[1], hall[2], hole[1]),
        (hall[0], hole[1], hole[0], hall[3]),
        (hole[2], hole[1], hall[2], hall[3]),
    ]


def _floor(builder: WorldBuilder, outline: Box, z: float, level: int, slab: float, color: tuple) -> None:
    corners = rectangle(_middle(outline), (outline[2] - outline[0], outline[3] - outline[1]))
    builder.add_surface("floor", corners, color, plane=(0.0, 0.0, z), level=level, texture=1.5, thickness=slab)


def before_door(builder: WorldBuilder, door) -> Box:
    """The floor on both sides of a door, in the builder's frame."""
    x, y = builder.from_world(np.array(door.position[:2]))
    along = abs(np.cos(door.heading - builder.heading)) > 0.5
    half_x, half_y = (0.95, door.width / 2 + 0.15) if along else (door.width / 2 + 0.15, 0.95)
    return (x - half_x, y - half_y, x + half_x, y + half_y)


def _middle(box: Box) -> tuple[float, float]:
    return (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
