"""Seeded places outdoors: streets with a pavement, a square and a terrace, and hillsides of three terraces.

Stairs and ramps lead up to the terrace of a street; those of a hillside lie some four metres above each other.
"""

from dataclasses import dataclass

import numpy as np

from wearsim.places.builder import WorldBuilder, hue
from wearsim.places.furniture import MAKERS, Plan
from wearsim.places.outline import Box
from wearsim.places.walls import KERB_TREAD_M, STONE, barrier, build_facade, build_flight, sloped_rail
from wearsim.places.world import Flight, World

KERB_STONE_M = 0.15
LONGEST_RAMP_M = 9.5
SQUARE_KINDS = (
    *("tree", "bench", "board", "bin", "tree", "low_wall"),
    *("bench", "planter", "street_lamp", "bush", "bollard"),
)
PAVEMENT_KINDS = ("street_lamp", "letter_box", "bench", "bollard", "tree", "bin")
TERRACE_KINDS = ("bench", "planter", "bin")
"""Furniture of each part, in order of preference."""
HILL_KINDS = ("bench", "planter", "tree", "bin", "street_lamp", "low_wall")
HILL_DEPTH_M = 6.2
"""Depth of a whole hillside, across the slope."""
HILL_STAIRS_M, HILL_RAMP_M = 2.4, 3.6
"""Across the slope, stairs and the path after them are below the first, the ramp above the second."""
PLATEAU_M = 6.0
PAVING, MEADOW = (0.60, 0.58, 0.54), (0.42, 0.52, 0.32)


@dataclass(frozen=True)
class _Ramp:
    box: Box
    slope: float
    up: int
    """Sign of x along which the ramp rises."""


@dataclass(frozen=True)
class _Crossing:
    """A gap in the barriers along the kerb."""

    x: float
    """Middle (m)."""
    width: float
    drop: float
    """Length of the ramp to which the kerb may be lowered (m)."""
    lowered: bool
    """Whether the kerb is lowered; else it is stepped over."""


@dataclass(frozen=True)
class _Layout:
    """Lengths in m. The street runs along x; y rises from the street over kerb, pavement and square to a facade."""

    width: float
    street: float
    """Depth of the street, at z = 0."""
    pavement: float
    """y at which the pavement ends."""
    depth: float
    """y of the facade."""
    kerb: float
    """Height of pavement and square."""
    top: float
    """Height of the terrace."""
    terrace: Box
    ramp: _Ramp
    stairs: Flight
    """Stairs from the square to the terrace."""
    crossings: tuple[_Crossing, ...]
    """From left to right."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "_Layout":
        kerb, street = rng.uniform(0.10, 0.15), rng.uniform(3.6, 5.5)
        pavement = street + rng.uniform(2.2, 3.2)
        steps, rise, tread = int(rng.integers(3, 7)), rng.uniform(0.15, 0.17), rng.uniform(0.30, 0.32)
        height = steps * rise
        slope = float(np.clip(rng.uniform(0.07, 0.10), height / LONGEST_RAMP_M, 0.10))
        run, ramp_width = height / slope, rng.uniform(1.6, 2.1)
        long, deep = rng.uniform(4.5, 6.5), rng.uniform(2.8, 3.6)
        depth = pavement + deep + (steps - 1) * tread + rng.uniform(2.2, 3.5)
        margin, entry = rng.uniform(0.0, 2.5), rng.uniform(2.0, 4.0)
        width = margin + long + run + entry
        stair_width = rng.uniform(1.5, 2.4)
        stair_x = margin + rng.uniform(stair_width / 2 + 0.3, long - stair_width / 2 - 0.3)
        ramp_up = int(rng.choice([-1, 1]))  # falls towards larger x from a terrace on the left, or mirrored
        flip = (lambda low, high: (low, high)) if ramp_up < 0 else (lambda low, high: (width - high, width - low))
        terrace_x, ramp_x = (flip(margin, margin + long), flip(margin + long, margin + long + run))
        count = int(rng.integers(2, 4))
        slots = (np.arange(count) + 0.5) * width / count
        slots += rng.uniform(-0.25, 0.25, count) * width / count
        crossings = [(float(x), float(rng.uniform(1.6, 2.6))) for x in slots]
        dropped, drop = int(rng.integers(-1, count)), kerb / rng.uniform(0.08, 0.10)
        y, top = depth - deep, kerb + height
        start = (flip(stair_x, stair_x)[0], y - (steps - 1) * tread)
        return cls(
            width,
            street,
            pavement,
            depth,
            kerb,
            top,
            (terrace_x[0], y, terrace_x[1], depth),
            _Ramp((ramp_x[0], depth - ramp_width, ramp_x[1], depth), slope, ramp_up),
            Flight(start, np.pi / 2, steps, (top - kerb) / steps, tread, stair_width, kerb),
            tuple(_Crossing(*place, drop, number == dropped) for number, place in enumerate(crossings)),
        )

    def build_ground(self, builder: WorldBuilder, rng: np.random.Generator) -> None:
        """Street, kerb stones, pavement (lowered at one crossing) and square, in a meadow that is only visible."""
        width, street, kerb = self.width, self.street, self.kerb
        shade = rng.uniform(0.30, 0.42)
        builder.add_slab("floor", (0.0, 0.0, width, street), 0.0, 0.05, (shade, shade, shade * 1.04), 3.0)
        inner = street + KERB_STONE_M
        pieces = [(0.0, width)]
        for crossing in self.crossings:
            if not crossing.lowered:
                continue
            low, high = crossing.x - crossing.width / 2, crossing.x + crossing.width / 2
            pieces, end = [(0.0, low), (high, width)], street + crossing.drop
            slope = kerb / crossing.drop
            builder.add_slab("ramp", (low, street, high, end), kerb, kerb, PAVING, 6.0, (0.0, slope, -slope * street))
            for a, b in pieces:
                builder.add_slab("floor", (a, inner, b, end), kerb, kerb, PAVING, 6.0)
            inner = end
        for a, b in pieces:
            builder.add_slab("kerb", (a, street, b, street + KERB_STONE_M), kerb, kerb, STONE, 12.0)
        builder.add_slab("floor", (0.0, inner, width, self.pavement), kerb, kerb, PAVING, 6.0)
        warm, light = rng.uniform(0.0, 0.16), rng.uniform(0.45, 0.75)  # gravel, clinker or flagstones
        earthy = light * (1.0 + warm), light, light * (1.0 - warm)
        builder.add_slab("floor", (0.0, self.pavement, width, self.depth), kerb, kerb, earthy, 5.0)
        center = (width / 2, self.depth / 2, -0.11)
        builder.add_box(center, (width + 24.0, self.depth + 24.0, 0.1), MEADOW, 1.0)
        for name, low, high, z in (
            ("street", 0.0, street, 0.0),
            ("pavement", street, self.pavement, kerb),
            ("square", self.pavement, self.stairs.start[1], kerb),
        ):
            builder.add_room(name, (0.0, low, width, high), z)

    def build_terrace(self, builder: WorldBuilder) -> None:
        """A raised floor with railings, open to the stairs before it and to the ramp beside it."""
        top, base, (x_low, y_low, x_high, y_high), ramp = self.top, self.kerb, self.terrace, self.ramp
        box, up = ramp.box, ramp.up
        foot, head = (box[0], box[2]) if up > 0 else (box[2], box[0])
        plane = up * ramp.slope, 0.0, top - up * ramp.slope * head
        builder.add_slab("floor", self.terrace, top, top - base, STONE, 6.0)
        builder.add_slab("ramp", box, top, top - base, (0.62, 0.60, 0.57), 6.0, plane)
        build_flight(builder, self.stairs, color=STONE)
        x, wide = self.stairs.start[0], self.stairs.width
        side, far = (x_low, x_high) if up > 0 else (x_high, x_low)
        edge = 0.05
        for a, b in (
            ((x_low + edge, y_low + edge), (x - wide / 2 - 0.03, y_low + edge)),
            ((x + wide / 2 + 0.03, y_low + edge), (x_high - edge, y_low + edge)),
            ((side + up * edge, y_low + edge), (side + up * edge, box[1])),
            ((far - up * edge, y_low + edge), (far - up * edge, y_high)),
        ):
            sloped_rail(builder, a, b, base, (top, top))
        sloped_rail(builder, (foot, box[1] + edge), (head, box[1] + edge), base, (base, top))
        builder.add_room("terrace", self.terrace, top)

    def build_borders(self, builder: WorldBuilder, rng: np.random.Generator) -> None:
        """The kerb, a house behind the square, one across the street or at an end, garden walls and hedges.

        Cars, hedges and railings line the kerb, which is stepped over, or walked down, where they leave gaps.
        """
        street, kerb, width, depth = self.street, self.kerb, self.width, self.depth
        at = 0.0
        for crossing in self.crossings:
            x, half = crossing.x, crossing.width / 2
            barrier(builder, (at, x - half), street, (0.0, kerb), rng, street > 4.6)
            at = x + half
            if not crossing.lowered:
                start, direction = builder.point(x, street), builder.heading + np.pi / 2
                builder.places.flights.append(Flight(start, direction, 1, kerb, KERB_TREAD_M, crossing.width, 0.0))
            for side in (-1, 1) if crossing.lowered else ():
                beside = x + side * (half + 0.06)
                sloped_rail(builder, (beside, street), (beside, street + crossing.drop), kerb, (kerb, kerb), 0.6)
        barrier(builder, (at, width), street, (0.0, kerb), rng, street > 4.6)
        doors = [(self.terrace[0] + rng.uniform(0.3, 0.7) * (self.terrace[2] - self.terrace[0]), self.top)]
        doors.append((width - 1.0 if self.ramp.up < 0 else 1.0, kerb))
        build_facade(builder, (0.0, depth, width, depth + 0.4), rng.uniform(5.0, 7.5), doors, self.top, rng)
        for x in np.arange(0.0, width - 2.0, 3.0):
            if rng.uniform() < 0.75:
                tall, hedge = rng.uniform(0.8, 2.2), rng.uniform() < 0.5
                color, texture = ((0.22, 0.42, 0.2), 35.0) if hedge else (hue(rng, (0.1, 0.35)), 9.0)
                center = (x + 1.5, -0.25, tall / 2)
                builder.add_block(
                    "hedge" if hedge else "wall", center, (rng.uniform(2.0, 3.0), 0.4, tall), color, texture
                )
        for x in (-0.2, width + 0.2):
            if rng.uniform() < 0.6:
                tall, low = rng.uniform(0.9, 2.4), rng.uniform(street, self.pavement)
                center = (x, (low + depth) / 2, tall / 2 + kerb)
                builder.add_block("wall", center, (0.3, depth - low, tall), hue(rng, (0.1, 0.35)), 9.0)
        for x in rng.uniform(0.0, width, 4):
            tree = MAKERS["tree"](rng)
            builder.place(tree, (float(x), float(rng.uniform(-4.0, -1.5)), -0.06), 0.0)


def build_outdoor(rng: np.random.Generator, name: str) -> World:
    """An open place with kerbs of 10–15 cm, stairs and a ramp of 7–10 %."""
    builder = WorldBuilder.drawn(name, rng, outdoors=True)
    layout = _Layout.drawn(rng)
    layout.build_ground(builder, rng)
    layout.build_terrace(builder)
    layout.build_borders(builder, rng)
    _furnish(builder, layout, rng)
    return builder.finish()


def _furnish(builder: WorldBuilder, layout: _Layout, rng: np.random.Generator) -> None:
    """Benches, trees and posts where they block no path."""
    width, street, kerb = layout.width, layout.street, layout.kerb
    (x, foot), half = layout.stairs.start, layout.stairs.width / 2 + 0.3
    left, front, right, back = layout.terrace
    falls, (low, ramp_y, high, _) = layout.ramp.up < 0, layout.ramp.box
    free: list[Box] = [(x - half, foot - 1.5, x + half, front)]
    for crossing in layout.crossings:
        low_x, high_x = crossing.x - crossing.width / 2, crossing.x + crossing.width / 2
        free.append((low_x - 0.2, street - 1.4, high_x + 0.2, street + crossing.drop + 1.2))
    end = (high, high + 1.6) if falls else (low - 1.6, low)
    free.append((end[0], ramp_y - 0.5, end[1], back))
    terrace = (left + 0.2, front + 0.2, right - 0.2, back - 0.05)
    stairs_head = (x - half, front, x + half, front + 1.2)
    ramp_x = (terrace[2] - 1.2, terrace[2]) if falls else (terrace[0], terrace[0] + 1.2)
    ramp_head = (ramp_x[0], ramp_y - 0.4, ramp_x[1], terrace[3])
    for room, z, kinds in (
        ((0.3, layout.pavement, width - 0.3, front - 0.2), kerb, SQUARE_KINDS),
        ((0.3, street + 0.7, width - 0.3, layout.pavement), kerb, PAVEMENT_KINDS),
        (terrace, layout.top, TERRACE_KINDS),
    ):
        plan = Plan(builder, room, z, [*free, stairs_head, ramp_head])
        for kind in kinds:
            if rng.uniform() < 0.85:
                plan.somewhere(kind, rng)


def build_hillside(rng: np.random.Generator, name: str) -> World:
    """Terraces at -4 … 4 m (3.4 m apart at least), stairs of 15–17 cm steps and ramps of 10–15 % between them.

    x rises with the slope; the middle terrace lies at z = 0 from x = 0 to `PLATEAU_M`.
    """
    builder = WorldBuilder.drawn(name, rng, outdoors=True)
    steps, riser = int(rng.integers(22, 25)), rng.uniform(0.155, 4.0 / 24)
    rise, tread, slope = steps * riser, rng.uniform(0.28, 0.32), rng.uniform(0.10, 0.15)
    stairs, ramp = (steps - 1) * tread, rise / slope
    _add_hill_terrace(builder, "middle", [(0.0, 0.0, PLATEAU_M, HILL_DEPTH_M)], 0.0, rng)
    # Above the middle the stairs start where the ramp starts, below it they end where the ramp ends.
    for x, foot, base in ((PLATEAU_M, PLATEAU_M, 0.0), (-ramp, -stairs, -rise)):
        box, ends = (x, HILL_RAMP_M, x + ramp, HILL_DEPTH_M), (base, base + rise)
        builder.add_slab("ramp", box, ends[1], 0.3, PAVING, 6.0, (slope, 0.0, base - slope * x))
        start = (foot, 0.1 + HILL_STAIRS_M / 2)
        flight = Flight(start, 0.0, steps, rise / steps, tread, HILL_STAIRS_M - 0.3, base)
        build_flight(builder, flight, color=STONE)
        for y in (HILL_RAMP_M - 0.1, HILL_DEPTH_M - 0.05):
            sloped_rail(builder, (x, y), (x + ramp, y), base, ends)
    top = PLATEAU_M + ramp
    path = (PLATEAU_M + stairs, 0.0, top, HILL_STAIRS_M + 0.8)
    _add_hill_terrace(builder, "upper", [path, (top, 0.0, top + PLATEAU_M, HILL_DEPTH_M)], rise, rng)
    path = (-ramp, 0.0, -stairs, HILL_STAIRS_M + 0.8)
    _add_hill_terrace(builder, "lower", [path, (-ramp - PLATEAU_M, 0.0, -ramp, HILL_DEPTH_M)], -rise, rng)
    return builder.finish()


def _add_hill_terrace(builder: WorldBuilder, name: str, boxes: list[Box], z: float, rng: np.random.Generator) -> None:
    """Level ground; the last box is the place itself, with its furniture, and open to the paths that lead to it."""
    for box in boxes:
        builder.add_slab("floor", box, z, 0.3, PAVING, 6.0)
    x_low, _, x_high, _ = boxes[-1]
    builder.add_room(name, boxes[-1], z)
    plan = Plan(builder, (x_low + 1.2, 0.3, x_high - 1.2, HILL_DEPTH_M - 0.3), z)
    for kind in rng.permutation(HILL_KINDS)[:3]:
        plan.somewhere(str(kind), rng)
