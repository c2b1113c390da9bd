"""Seeded sites of about 1000 m²: rooms, a corridor, halls, a terrace in front, stairs and a ramp to a yard.

`changed_world` is the same place some days later: some objects stand elsewhere, others are gone.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from wearsim.places.builder import WorldBuilder, hue
from wearsim.places.furniture import MAKERS, ROOM_KINDS, Plan, wood
from wearsim.places.outline import Box, inset, middle_and_size, overlaps, rectangle, turn
from wearsim.places.walls import HEIGHT, STONE, THICKNESS, Wall, before_gap, build_facade, build_flight, sloped_rail
from wearsim.places.world import CaptureSpot, Flight, World

SPOT_M = 4.0
"""Side of the capture spot."""
RISE_M, RISERS, TREAD_M = 0.16, 2, 0.31
BASE = -RISERS * RISE_M
"""Height of the yard."""
RAMP_SLOPE = 0.08
HALL_KINDS = ("shelf", "board", "cabinet", "plant", "shelf", "desk", "sofa", "shelf", "board", "plant", "shelf")
YARD_KINDS = (
    *("tree", "bench", "board", "planter", "bush", "tree", "low_wall", "street_lamp", "bin"),
    *("bench", "letter_box", "tree", "bush", "planter", "bollard", "tree", "low_wall", "street_lamp"),
)
TERRACE_KINDS = ("bench", "planter", "bin", "board")
"""Furniture of each part, in order of preference."""
MOVABLE = (
    *("chair", "armchair", "plant", "lamp", "board", "bin", "bench", "coffee_table", "table"),
    *("desk", "cabinet", "sofa", "planter"),
)
"""Kinds of objects that may stand elsewhere, or be gone, some days later."""
MOST_M = 0.5
"""Largest displacement of such an object (m)."""


@dataclass(frozen=True)
class _Layout:
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

    @classmethod
    def drawn(cls, rng: np.random.Generator, scale: float) -> "_Layout":
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
        terrace, ramp = (0.0, top, width, edge), (ramp_x - half, edge, ramp_x + half, edge + run)
        return cls(width, rooms, corridor, halls, terrace, yard, ramp, stair_x, rng.uniform(1.8, 2.8))

    def walls(self, rng: np.random.Generator) -> list[Wall]:
        """Outer walls with windows, doors to the terrace, a door or two to the corridor from every room and hall."""
        width, top = self.width, self.terrace[1]
        low, high = self.corridor[1], self.corridor[3]
        south, north, below, above = (Wall((0.0, y), (width, y)) for y in (0.0, top, low, high))
        west, east = (Wall((x, 0.0), (x, top), windows=[((low + high) / 2, 1.0)]) for x in (0.0, width))
        for box in self.rooms:
            south.windows += _row(box, 2.6, rng.uniform(1.0, 1.5))
            below.doors.append((float(rng.uniform(box[0] + 0.9, box[2] - 0.9)), float(rng.uniform(0.85, 0.95))))
        for box in self.halls:
            middle, span = (box[0] + box[2]) / 2, box[2] - box[0]
            door = middle + float(rng.uniform(-0.15, 0.15)) * span
            north.doors.append((door, float(rng.uniform(1.2, 1.8))))
            north.windows += [w for w in _row(box, 3.2, rng.uniform(1.2, 1.8)) if abs(w[0] - door) > 2.2]
            for share in (0.22, 0.78):
                above.doors.append((box[0] + share * span + float(rng.uniform(-0.4, 0.4)), 1.1))
        walls = [south, north, west, east, below, above]
        for box in (*self.rooms[1:], *self.halls[1:]):
            between = Wall((box[0], box[1]), (box[0], box[3]))
            if rng.uniform() < 0.6:
                between.doors.append((float(rng.uniform(0.3, 0.7)) * between.length, 0.95))
            walls.append(between)
        return walls

    def build_open_air(self, builder: WorldBuilder, rng: np.random.Generator) -> None:
        """Terrace, stairs and ramp with their railings, the yard's paving and lawn, walls and a house around it."""
        x_low, y_low, x_high, edge = self.terrace
        paving, gray = (0.62, 0.60, 0.56), float(rng.uniform(0.34, 0.46))
        builder.add_slab("floor", self.terrace, 0.0, -BASE + 0.05, STONE, 6.0)
        builder.add_slab("ramp", self.ramp, 0.0, -BASE, paving, 6.0, (0.0, -RAMP_SLOPE, RAMP_SLOPE * edge))
        start = (self.stair_x, edge + (RISERS - 1) * TREAD_M)
        build_flight(builder, Flight(start, -np.pi / 2, RISERS, RISE_M, TREAD_M, self.stair_width, BASE), color=STONE)
        half = self.stair_width / 2
        gaps = sorted([(self.ramp[0], self.ramp[2]), (self.stair_x - half - 0.03, self.stair_x + half + 0.03)])
        ends = [x_low + 0.05, *(x for gap in gaps for x in gap), x_high - 0.05]
        for a, b in zip(ends[::2], ends[1::2]):
            if b - a > 0.1:
                sloped_rail(builder, (a, edge - 0.05), (b, edge - 0.05), BASE, (0.0, 0.0))
        for x in (self.ramp[0] + 0.05, self.ramp[2] - 0.05):
            sloped_rail(builder, (x, edge), (x, self.ramp[3]), BASE, (0.0, BASE))
        far = self.yard[3]
        lawn = edge + (far - edge) * 0.62
        builder.add_slab("floor", (x_low, edge, x_high, lawn), BASE, 0.05, (gray, gray, 1.04 * gray), 3.0)
        builder.add_slab("floor", (x_low, lawn, x_high, far), BASE, 0.05, (0.30, 0.46, 0.22), 12.0)
        builder.add_room("terrace", self.terrace, 0.0, open_air=True)
        builder.add_room("yard", self.yard, BASE, open_air=True)
        doors = [(float(x_high * share), BASE) for share in (0.3, 0.75)]
        build_facade(builder, (x_low - 2, far, x_high + 2, far + 0.4), rng.uniform(5.5, 8.0), doors, BASE, rng)
        for x in (x_low - 0.2, x_high + 0.2):
            for y, next_y in pairwise(np.linspace(y_low + 0.1, far, 5)):
                tall, hedge = rng.uniform(1.3, 2.4), rng.uniform() < 0.4
                center, size = (x, (y + next_y) / 2, BASE + tall / 2), (0.3, next_y - y, tall)
                if hedge:
                    builder.add_block("hedge", center, size, (0.24, 0.42, 0.2), 35.0)
                else:
                    color = tuple(rng.uniform(0.4, 0.75) * np.array((1.0, 0.82, 0.72)))
                    builder.add_block("garden_wall", center, size, color, 9.0)
        ground = ((x_low + x_high) / 2, far / 2, BASE - 0.11)
        builder.add_box(ground, (self.width + 30.0, far + 30.0, 0.1), (0.40, 0.50, 0.30), 1.0)


def build_site(rng: np.random.Generator, name: str, scale: float = 1.0) -> World:
    """A site with its capture spot in the first hall; `scale` below 1 makes it smaller (0.6: about a third)."""
    builder = WorldBuilder.drawn(name, rng)
    layout = _Layout.drawn(rng, scale)
    walls = layout.walls(rng)
    painted = hue(rng, (0.0, 0.12))
    for wall in walls:
        wall.build(builder, painted, rng)
    rooms = [(f"room {number}", box) for number, box in enumerate(layout.rooms)]
    halls = [(f"hall {number}", box) for number, box in enumerate(layout.halls)]
    for part, box in (*rooms, ("corridor", layout.corridor), *halls):
        middle, size = middle_and_size(box)
        shade = float(rng.uniform(0.45, 0.75))
        color = wood(rng) if part.startswith("room") else (shade, 0.98 * shade, 0.93 * shade)
        builder.add_surface("floor", rectangle(middle, size), color, texture=1.5, thickness=0.05)
        builder.add_room(part, rectangle(middle, size), 0.0)
        builder.add_box((*middle, HEIGHT + 0.05), (*size, 0.1), (0.88, 0.88, 0.86), 0.8)
        for x in np.arange(box[0] + 1.3, box[2] - 1.0, 2.8):
            for y in np.arange(box[1] + 1.2, box[3] - 0.8, 2.6):
                builder.add_box((float(x), float(y), HEIGHT - 0.03), (1.25, 0.28, 0.06), (1.0, 1.0, 0.97), 8.0)
    layout.build_open_air(builder, rng)
    _furnish(builder, layout, rng)
    return builder.finish()


def _side_by_side(rng: np.random.Generator, width: float, count: int, low: float, high: float) -> tuple[Box, ...]:
    shares = 1.0 + rng.uniform(-0.18, 0.18, count)
    edges = np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * width
    return tuple((float(a), low, float(b), high) for a, b in pairwise(edges))


def _row(box: Box, spacing: float, width: float) -> list[tuple[float, float]]:
    """Windows spread over a room's length."""
    count = max(int((box[2] - box[0] - 0.8) / spacing), 1)
    return [(box[0] + (k + 0.5) * (box[2] - box[0]) / count, float(width)) for k in range(count)]


def _furnish(builder: WorldBuilder, layout: _Layout, rng: np.random.Generator) -> None:
    free, margin = [before_gap(builder, door) for door in builder.places.doors], THICKNESS / 2 + 0.01
    kinds = rng.permutation([*ROOM_KINDS, *ROOM_KINDS])
    for box, kind in zip(layout.rooms, kinds):
        plan = Plan(builder, inset(box, margin), 0.0, list(free))
        plan.furnish(str(kind), rng)
        plan.table_with_chairs(rng)
        for extra in ("shelf", "plant", "cabinet"):
            plan.against_wall(MAKERS[extra](rng), rng)
    for number, box in enumerate(layout.halls):
        plan = Plan(builder, inset(box, margin), 0.0, list(free))
        if number == 0:
            # the capture spot: a free square in the middle of the hall, a table at one side of it
            x_low, y_low, x_high, y_high = plan.room
            table, half = MAKERS["table"](rng), SPOT_M / 2
            x, y = float(rng.uniform(x_low + half + 0.8, x_high - half - 0.8)), (y_low + y_high) / 2
            for heading in rng.permutation(4) * np.pi / 2:
                ahead = np.array([np.cos(heading), np.sin(heading)])
                place = np.array([x, y]) + (half + table.size[0] / 2) * ahead
                if plan.try_place(table, float(place[0]), float(place[1]), float(heading + np.pi)):
                    break
            else:
                raise AssertionError("a hall always has room for the capture spot's table")
            plan.kept_free.append((x - half, y - half, x + half, y + half))
            at, facing = builder.point(x, y, plan.z), builder.heading + float(heading)
            builder.places.spots.append(CaptureSpot(at, facing, SPOT_M, half, table.z_range[1]))
        # columns down the middle, out of the walkers' path, with notices on them
        y, color = (plan.room[1] + plan.room[3]) / 2, hue(rng, (0.0, 0.1))
        for x in np.arange(plan.room[0] + 2.5, plan.room[2] - 1.5, 4.2):
            outline = (x - 0.25, y - 0.25, x + 0.25, y + 0.25)
            if any(overlaps(outline, other) for other in (*plan.kept_free, *plan.solid)):
                continue
            builder.add_block("pillar", (float(x), y, HEIGHT / 2), (0.36, 0.36, HEIGHT), color, 1.0)
            plan.solid.append(outline)
            notice = (float(x), y + float(rng.choice([-1.0, 1.0])) * 0.19, 1.5)
            builder.add_box(notice, (0.28, 0.02, 0.4), tuple(rng.uniform(0.3, 0.9, 3)), 150.0)
        for _ in range(3):
            plan.table_with_chairs(rng)
        for kind in HALL_KINDS:
            plan.against_wall(MAKERS[kind](rng), rng)
        for kind in ("board", "bench", "plant"):
            plan.somewhere(kind, rng)
    corridor = Plan(builder, inset(layout.corridor, margin), 0.0, list(free))
    for kind in ("plant", "cabinet", "plant"):
        corridor.against_wall(MAKERS[kind](rng), rng)
    half, edge = layout.stair_width / 2 + 0.5, layout.yard[1]
    stairs = (layout.stair_x - half, edge - 1.4, layout.stair_x + half, edge + TREAD_M + 1.6)
    ramp = (layout.ramp[0] - 0.3, edge - 1.5, layout.ramp[2] + 0.3, layout.ramp[3] + 1.6)
    yard, terrace = inset(layout.yard, 0.4), inset(layout.terrace, 0.2)
    for box, z, kinds in ((yard, BASE, YARD_KINDS), (terrace, 0.0, TERRACE_KINDS)):
        plan = Plan(builder, box, z, [stairs, ramp, *free])
        for kind in kinds:
            plan.somewhere(kind, rng)


def changed_world(world: World, rng: np.random.Generator, moved: float = 0.4, removed: float = 0.15) -> World:
    """The world with these shares of its movable objects shifted (and turned), or removed.

    Walkers keep to the world as it was: objects are moved by at most `MOST_M`. The capture spots' tables stay.
    """
    vertices, kept = world.mesh.vertices.copy(), np.ones(len(world.mesh.faces), bool)
    objects = list(world.objects)
    for number, item in enumerate(world.objects):
        luck = rng.random()
        shift, angle = rng.uniform(-MOST_M, MOST_M, 2) / np.sqrt(2), rng.normal(0.0, 0.4)
        here = np.array(item.position[:2])
        at_spot = any(np.linalg.norm(here - spot.position[:2]) < spot.size for spot in world.places.spots)
        if item.kind not in MOVABLE or luck > moved + removed or at_spot:
            continue
        own = world.face_object == number
        if luck < removed:
            kept &= ~own
            continue
        corners, center = np.unique(world.mesh.faces[own]), here
        about = lambda points: (points - center) @ turn(angle).T + center + shift  # noqa: B023, E731
        vertices[corners, :2] = about(vertices[corners, :2].astype(np.float64))
        place = (*(center + shift).tolist(), item.position[2])
        objects[number] = replace(
            item, footprint=about(item.footprint), position=place, heading=item.heading + float(angle)
        )
    mesh = replace(world.mesh, vertices=vertices, faces=world.mesh.faces[kept])
    return replace(
        world,
        mesh=mesh,
        face_object=world.face_object[kept],
        face_texture=world.face_texture[kept],
        objects=tuple(objects),
    )
