"""Seeded sites of about 1000 m²: rooms, a corridor, halls, a terrace in front, stairs and a ramp to a yard."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from wearcap.simulation.places.builder import WorldBuilder, hue
from wearcap.simulation.places.flat import before_door
from wearcap.simulation.places.furnish import ROOM_KINDS, Box, Plan, middle_and_size, overlaps
from wearcap.simulation.places.furniture import MAKERS, wood
from wearcap.simulation.places.outdoor import put_somewhere
from wearcap.simulation.places.outline import rectangle
from wearcap.simulation.places.street import STONE, build_facade, slab, sloped_rail
from wearcap.simulation.places.walls import HEIGHT, THICKNESS, Wall, build_flight, build_wall
from wearcap.simulation.places.world import CaptureSpot, Room, World

SPOT_M = 4.0
"""Side of the capture spot."""
RISE_M, RISERS, TREAD_M = 0.16, 2, 0.31
RAMP_SLOPE = 0.08
HALL_KINDS = ("shelf", "board", "cabinet", "plant", "shelf", "desk", "sofa", "shelf", "board", "plant", "shelf")
YARD_KINDS = (
    "tree",
    "bench",
    "board",
    "planter",
    "bush",
    "tree",
    "low_wall",
    "street_lamp",
    "bin",
    "bench",
    "letter_box",
    "tree",
    "bush",
    "planter",
    "bollard",
    "tree",
    "low_wall",
    "street_lamp",
)
TERRACE_KINDS = ("bench", "planter", "bin", "board")
"""Furniture of each part, in order of preference."""


@dataclass(frozen=True)
class Layout:
    """Lengths in m. From y = 0: rooms, a corridor, halls, a terrace, a lower yard, and a facade across it."""

    width: float
    rooms: tuple[Box, ...]
    corridor: Box
    halls: tuple[Box, ...]
    terrace: Box
    yard: Box
    ramp: Box
    stair_x: float
    stair_width: float

    @property
    def indoors(self) -> tuple[Box, ...]:
        return (*self.rooms, self.corridor, *self.halls)


def build_site(rng: np.random.Generator, name: str, scale: float = 1.0) -> World:
    """A site with its capture spot in the first hall; `scale` below 1 makes it smaller (0.6: about a third)."""
    builder = WorldBuilder(name, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-5.0, 5.0, 2).tolist()))
    layout = _draw_layout(rng, scale)
    walls = _walls(layout, rng)
    painted = hue(rng, (0.0, 0.12))
    for wall in walls:
        build_wall(builder, wall, painted, rng)
    for number, box in enumerate(layout.indoors):
        _shell(builder, box, _name(layout, number), rng)
    _build_open_air(builder, layout, rng)
    _furnish_inside(builder, layout, rng)
    _furnish_open_air(builder, layout, rng)
    return builder.finish(cell=0.1)


def _name(layout: Layout, number: int) -> str:
    rooms = len(layout.rooms)
    if number == rooms:
        return "corridor"
    return f"room {number}" if number < rooms else f"hall {number - rooms - 1}"


def _draw_layout(rng: np.random.Generator, scale: float) -> Layout:
    width = scale * rng.uniform(28.0, 32.0)
    deep_rooms, deep_halls = scale * rng.uniform(6.3, 7.2), scale * rng.uniform(8.8, 10.0)
    corridor = (0.0, deep_rooms, width, deep_rooms + rng.uniform(2.4, 2.8))
    top = corridor[3] + deep_halls
    rooms = _side_by_side(rng, width, max(round(5 * scale), 2), 0.0, deep_rooms)
    halls = _side_by_side(rng, width, 2, corridor[3], top)
    edge = top + rng.uniform(3.0, 3.6)
    run = RISERS * RISE_M / RAMP_SLOPE
    yard = (0.0, edge, width, edge + max(scale * rng.uniform(10.0, 12.0), run + 2.5))
    ramp_x, stair_x = width * rng.uniform(0.12, 0.3), width * rng.uniform(0.5, 0.85)
    if rng.uniform() < 0.5:
        ramp_x, stair_x = width - ramp_x, width - stair_x
    half = rng.uniform(0.8, 1.0)
    return Layout(
        width,
        rooms,
        corridor,
        halls,
        (0.0, top, width, edge),
        yard,
        (ramp_x - half, edge, ramp_x + half, edge + run),
        stair_x,
        rng.uniform(1.8, 2.8),
    )


def _side_by_side(rng: np.random.Generator, width: float, count: int, low: float, high: float) -> tuple[Box, ...]:
    shares = 1.0 + rng.uniform(-0.18, 0.18, count)
    edges = np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * width
    return tuple((float(a), low, float(b), high) for a, b in pairwise(edges))


def _walls(layout: Layout, rng: np.random.Generator) -> list[Wall]:
    """Outer walls with windows, doors to the terrace, a door or two to the corridor from every room and hall."""
    width, top = layout.width, layout.terrace[1]
    low, high = layout.corridor[1], layout.corridor[3]
    south, west, east = Wall((0.0, 0.0), (width, 0.0)), Wall((0.0, 0.0), (0.0, top)), Wall((width, 0.0), (width, top))
    north, below, above = (Wall((0.0, y), (width, y)) for y in (top, low, high))
    for box in layout.rooms:
        south.windows += _row(box, 2.6, rng.uniform(1.0, 1.5))
        below.doors.append((float(rng.uniform(box[0] + 0.9, box[2] - 0.9)), float(rng.uniform(0.85, 0.95))))
    for box in layout.halls:
        middle, span = (box[0] + box[2]) / 2, box[2] - box[0]
        north.doors.append((middle + float(rng.uniform(-0.15, 0.15)) * span, float(rng.uniform(1.2, 1.8))))
        door = north.doors[-1][0]
        north.windows += [w for w in _row(box, 3.2, rng.uniform(1.2, 1.8)) if abs(w[0] - door) > 2.2]
        for share in (0.22, 0.78):
            above.doors.append((box[0] + share * span + float(rng.uniform(-0.4, 0.4)), 1.1))
    west.windows = [((low + high) / 2, 1.0)]
    east.windows = [((low + high) / 2, 1.0)]
    walls = [south, north, west, east, below, above]
    for row in (layout.rooms, layout.halls):
        for box in row[1:]:
            between = Wall((box[0], box[1]), (box[0], box[3]))
            if rng.uniform() < 0.6:
                between.doors.append((float(rng.uniform(0.3, 0.7)) * between.length, 0.95))
            walls.append(between)
    return walls


def _row(box: Box, spacing: float, width: float) -> list[tuple[float, float]]:
    """Windows spread over a room's length."""
    count = max(int((box[2] - box[0] - 0.8) / spacing), 1)
    return [(box[0] + (k + 0.5) * (box[2] - box[0]) / count, float(width)) for k in range(count)]


def _shell(builder: WorldBuilder, box: Box, name: str, rng: np.random.Generator) -> None:
    """Floor, ceiling with lamps, and the room's outline."""
    middle, size = middle_and_size(box)
    corners = rectangle(middle, size)
    shade = float(rng.uniform(0.45, 0.75))
    color = wood(rng) if name.startswith("room") else (shade, 0.98 * shade, 0.93 * shade)
    builder.add_surface("floor", corners, color, texture=1.5, thickness=0.05)
    builder.rooms.append(Room(name, builder.to_world(corners), 0.0))
    builder.add_box((*middle, HEIGHT + 0.05), (*size, 0.1), (0.88, 0.88, 0.86), 0.8)
    for x in np.arange(box[0] + 1.3, box[2] - 1.0, 2.8):
        for y in np.arange(box[1] + 1.2, box[3] - 0.8, 2.6):
            builder.add_box((float(x), float(y), HEIGHT - 0.03), (1.25, 0.28, 0.06), (1.0, 1.0, 0.97), 8.0)


def _build_open_air(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    """Terrace, stairs and ramp with their railings, the yard's paving and lawn, walls and a house around it."""
    base, (x_low, y_low, x_high, edge) = -RISERS * RISE_M, layout.terrace
    paving, gray = (0.62, 0.60, 0.56), float(rng.uniform(0.34, 0.46))
    slab(builder, "floor", layout.terrace, 0.0, -base + 0.05, STONE, 6.0)
    slope = (0.0, -RAMP_SLOPE, RAMP_SLOPE * edge)
    slab(builder, "ramp", layout.ramp, 0.0, -base, paving, 6.0, slope)
    start = (layout.stair_x, edge + (RISERS - 1) * TREAD_M)
    build_flight(builder, start, -np.pi / 2, RISERS, RISE_M, TREAD_M, layout.stair_width, base, (-1, 1), STONE)
    gaps = sorted(
        [
            (layout.ramp[0], layout.ramp[2]),
            (layout.stair_x - layout.stair_width / 2 - 0.03, layout.stair_x + layout.stair_width / 2 + 0.03),
        ]
    )
    ends = [x_low + 0.05, *(x for gap in gaps for x in gap), x_high - 0.05]
    for a, b in zip(ends[::2], ends[1::2]):
        if b - a > 0.1:
            sloped_rail(builder, (a, edge - 0.05), (b, edge - 0.05), base, (0.0, 0.0))
    for x in (layout.ramp[0] + 0.05, layout.ramp[2] - 0.05):
        sloped_rail(builder, (x, edge), (x, layout.ramp[3]), base, (0.0, base))
    far = layout.yard[3]
    lawn = edge + (far - edge) * 0.62
    slab(builder, "floor", (x_low, edge, x_high, lawn), base, 0.05, (gray, gray, 1.04 * gray), 3.0)
    slab(builder, "floor", (x_low, lawn, x_high, far), base, 0.05, (0.30, 0.46, 0.22), 12.0)
    for name, box, z in (("terrace", layout.terrace, 0.0), ("yard", layout.yard, base)):
        corners = np.array([[box[0], box[1]], [box[2], box[1]], [box[2], box[3]], [box[0], box[3]]])
        builder.rooms.append(Room(name, builder.to_world(corners), z, open_air=True))
    doors = [(float(x_high * share), base) for share in (0.3, 0.75)]
    build_facade(builder, (x_low - 2, far, x_high + 2, far + 0.4), rng.uniform(5.5, 8.0), doors, base, rng)
    for x in (x_low - 0.2, x_high + 0.2):
        for y, next_y in pairwise(np.linspace(y_low + 0.1, far, 5)):
            tall, hedge = rng.uniform(1.3, 2.4), rng.uniform() < 0.4
            color, texture = (
                ((0.24, 0.42, 0.2), 35.0)
                if hedge
                else (tuple(rng.uniform(0.4, 0.75) * np.array((1.0, 0.82, 0.72))), 9.0)
            )
            center, size = (x, (y + next_y) / 2, base + tall / 2), (0.3, next_y - y, tall)
            builder.add_block("hedge" if hedge else "garden_wall", center, size, color, texture)
    ground = ((x_low + x_high) / 2, far / 2, base - 0.11)
    builder.add_box(ground, (layout.width + 30.0, far + 30.0, 0.1), (0.40, 0.50, 0.30), 1.0)


def _furnish_inside(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    free, inset = [before_door(builder, door) for door in builder.doors], THICKNESS / 2 + 0.01
    kinds = rng.permutation([*ROOM_KINDS, *ROOM_KINDS])
    for box, kind in zip(layout.rooms, kinds):
        plan = Plan(builder, _inner(box, inset), 0.0, list(free))
        plan.furnish(str(kind), rng)
        plan.table_with_chairs(rng)
        for extra in ("shelf", "plant", "cabinet"):
            plan.against_wall(MAKERS[extra](rng), rng)
    for number, box in enumerate(layout.halls):
        plan = Plan(builder, _inner(box, inset), 0.0, list(free))
        if number == 0:
            _capture_spot(plan, rng)
        _pillars(plan, rng)
        for _ in range(3):
            plan.table_with_chairs(rng)
        for kind in HALL_KINDS:
            plan.against_wall(MAKERS[kind](rng), rng)
        for kind in ("board", "bench", "plant"):
            put_somewhere(plan, kind, rng)
    corridor = Plan(builder, _inner(layout.corridor, inset), 0.0, list(free))
    for kind in ("plant", "cabinet", "plant"):
        corridor.against_wall(MAKERS[kind](rng), rng)


def _inner(box: Box, inset: float) -> Box:
    return (box[0] + inset, box[1] + inset, box[2] - inset, box[3] - inset)


def _capture_spot(plan: Plan, rng: np.random.Generator) -> None:
    """A free square in the middle of a hall, a table at one side of it."""
    x_low, y_low, x_high, y_high = plan.room
    table, half = MAKERS["table"](rng), SPOT_M / 2
    depth = table.size[0] / 2
    x = float(rng.uniform(x_low + half + 0.8, x_high - half - 0.8))
    y = (y_low + y_high) / 2
    for heading in rng.permutation(4) * np.pi / 2:
        ahead = np.array([np.cos(heading), np.sin(heading)])
        place = np.array([x, y]) + (half + depth) * ahead
        if plan.try_place(table, float(place[0]), float(place[1]), float(heading + np.pi)):
            break
    else:
        raise AssertionError("a hall always has room for the capture spot's table")
    plan.kept_free.append((x - half, y - half, x + half, y + half))
    position = plan.builder.to_world(np.array([x, y, plan.z]))
    plan.builder.spots.append(
        CaptureSpot(tuple(position.tolist()), plan.builder.heading + float(heading), SPOT_M, half, table.z_range[1])
    )


def _pillars(plan: Plan, rng: np.random.Generator) -> None:
    """Columns down the middle of a hall, out of the walkers' path, with notices on them."""
    x_low, y_low, x_high, y_high = plan.room
    y, color = (y_low + y_high) / 2, hue(rng, (0.0, 0.1))
    for x in np.arange(x_low + 2.5, x_high - 1.5, 4.2):
        outline = (x - 0.25, y - 0.25, x + 0.25, y + 0.25)
        if any(overlaps(outline, other) for other in (*plan.kept_free, *plan.solid)):
            continue
        plan.builder.add_block("pillar", (float(x), y, HEIGHT / 2), (0.36, 0.36, HEIGHT), color, 1.0)
        plan.solid.append(outline)
        side = float(rng.choice([-1.0, 1.0]))
        plan.builder.add_box(
            (float(x), y + side * 0.19, 1.5), (0.28, 0.02, 0.4), tuple(rng.uniform(0.3, 0.9, 3)), 150.0
        )


def _furnish_open_air(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    half, edge = layout.stair_width / 2 + 0.5, layout.yard[1]
    stairs = (layout.stair_x - half, edge - 1.4, layout.stair_x + half, edge + TREAD_M + 1.6)
    ramp = (layout.ramp[0] - 0.3, edge - 1.5, layout.ramp[2] + 0.3, layout.ramp[3] + 1.6)
    free = [stairs, ramp, *(before_door(builder, door) for door in builder.doors)]
    base = -RISERS * RISE_M
    for box, z, kinds in (
        (_inner(layout.yard, 0.4), base, YARD_KINDS),
        (_inner(layout.terrace, 0.2), 0.0, TERRACE_KINDS),
    ):
        plan = Plan(builder, box, z, list(free))
        for kind in kinds:
            put_somewhere(plan, kind, rng)
