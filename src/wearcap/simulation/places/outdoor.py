"""Seeded places outdoors: a street, kerbs, a pavement, a square, and a terrace that stairs and a ramp lead up to."""

from dataclasses import dataclass

import numpy as np

from wearcap.simulation.places.builder import WorldBuilder, hue
from wearcap.simulation.places.furnish import FRONT_M, Box, Plan
from wearcap.simulation.places.furniture import MAKERS
from wearcap.simulation.places.street import STONE, barrier, build_facade, build_kerb, slab, sloped_rail
from wearcap.simulation.places.walls import build_flight
from wearcap.simulation.places.world import Room, World

KERB_STONE_M = 0.15
LONGEST_RAMP_M = 9.5
SQUARE_KINDS = (
    "tree",
    "bench",
    "board",
    "bin",
    "tree",
    "low_wall",
    "bench",
    "planter",
    "street_lamp",
    "bush",
    "bollard",
)
PAVEMENT_KINDS = ("street_lamp", "letter_box", "bench", "bollard", "tree", "bin")
TERRACE_KINDS = ("bench", "planter", "bin")
"""Furniture of each part, in order of preference."""


@dataclass(frozen=True)
class Layout:
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
    ramp: Box
    slope: float
    ramp_up: int
    """Sign of x along which the ramp rises."""
    steps: int
    tread: float
    stair_x: float
    stair_width: float
    crossings: tuple[tuple[float, float], ...]
    """Gaps in the barriers along the kerb as (middle x, width), from left to right."""
    dropped: int
    """Which crossing's kerb is lowered to a ramp; -1: none."""
    drop: float
    """Length of that ramp."""

    @property
    def stair_foot(self) -> float:
        """y of the first riser."""
        return self.terrace[1] - (self.steps - 1) * self.tread

    @property
    def ramp_plane(self) -> tuple[float, float, float]:
        edge = self.ramp[2] if self.ramp_up > 0 else self.ramp[0]
        return self.ramp_up * self.slope, 0.0, self.top - self.ramp_up * self.slope * edge


def build_outdoor(rng: np.random.Generator, name: str, ramp_slope: float | None = None) -> World:
    """An open place with kerbs of 10–15 cm, stairs and a ramp of 7–10 % (`ramp_slope` None leaves it to chance)."""
    builder = WorldBuilder(name, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-5.0, 5.0, 2).tolist()), outdoors=True)
    layout = _draw_layout(rng, ramp_slope)
    _build_ground(builder, layout, rng)
    _build_terrace(builder, layout)
    _line_kerb(builder, layout, rng)
    _build_borders(builder, layout, rng)
    _furnish(builder, layout, rng)
    return builder.finish(cell=0.1)


def _draw_layout(rng: np.random.Generator, ramp_slope: float | None) -> Layout:
    kerb, street = rng.uniform(0.10, 0.15), rng.uniform(3.6, 5.5)
    pavement = street + rng.uniform(2.2, 3.2)
    steps, rise, tread = int(rng.integers(3, 7)), rng.uniform(0.15, 0.17), rng.uniform(0.30, 0.32)
    height = steps * rise
    slope = float(np.clip(ramp_slope or rng.uniform(0.07, 0.10), height / LONGEST_RAMP_M, 0.10))
    run, ramp_width = height / slope, rng.uniform(1.6, 2.1)
    terrace = rng.uniform(4.5, 6.5), rng.uniform(2.8, 3.6)
    depth = pavement + terrace[1] + (steps - 1) * tread + rng.uniform(2.2, 3.5)
    margin, entry = rng.uniform(0.0, 2.5), rng.uniform(2.0, 4.0)
    width = margin + terrace[0] + run + entry
    stair_width = rng.uniform(1.5, 2.4)
    stair_x = margin + rng.uniform(stair_width / 2 + 0.3, terrace[0] - stair_width / 2 - 0.3)
    ramp_up = int(rng.choice([-1, 1]))  # falls towards larger x from a terrace on the left, or mirrored
    flip = (lambda low, high: (low, high)) if ramp_up < 0 else (lambda low, high: (width - high, width - low))
    terrace_x, ramp_x = (flip(margin, margin + terrace[0]), flip(margin + terrace[0], margin + terrace[0] + run))
    crossings = _draw_crossings(rng, width)
    return Layout(
        width,
        street,
        pavement,
        depth,
        kerb,
        kerb + height,
        (terrace_x[0], depth - terrace[1], terrace_x[1], depth),
        (ramp_x[0], depth - ramp_width, ramp_x[1], depth),
        slope,
        ramp_up,
        steps,
        tread,
        flip(stair_x, stair_x)[0],
        stair_width,
        crossings,
        int(rng.integers(-1, len(crossings))),
        kerb / rng.uniform(0.08, 0.10),
    )


def _draw_crossings(rng: np.random.Generator, width: float) -> tuple[tuple[float, float], ...]:
    count = int(rng.integers(2, 4))
    slots = (np.arange(count) + 0.5) * width / count
    slots += rng.uniform(-0.25, 0.25, count) * width / count
    return tuple((float(x), float(rng.uniform(1.6, 2.6))) for x in slots)


def _build_ground(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    """Street, kerb stones, pavement (lowered at one crossing) and square, in a meadow that is only visible."""
    width, street, kerb = layout.width, layout.street, layout.kerb
    shade = rng.uniform(0.30, 0.42)
    asphalt, paving = (shade, shade, shade * 1.04), (0.60, 0.58, 0.54)
    slab(builder, "floor", (0.0, 0.0, width, street), 0.0, 0.05, asphalt, 3.0)
    inner = street + KERB_STONE_M
    pieces = [(0.0, width)]
    if layout.dropped >= 0:
        x, wide = layout.crossings[layout.dropped]
        low, high = x - wide / 2, x + wide / 2
        pieces = [(0.0, low), (high, width)]
        slope = kerb / layout.drop
        plane = (0.0, slope, -slope * street)
        slab(builder, "ramp", (low, street, high, street + layout.drop), kerb, kerb, paving, 6.0, plane)
        for a, b in pieces:
            slab(builder, "floor", (a, inner, b, street + layout.drop), kerb, kerb, paving, 6.0)
        inner = street + layout.drop
    for a, b in pieces:
        slab(builder, "kerb", (a, street, b, street + KERB_STONE_M), kerb, kerb, STONE, 12.0)
    slab(builder, "floor", (0.0, inner, width, layout.pavement), kerb, kerb, paving, 6.0)
    square = (0.0, layout.pavement, width, layout.depth)
    slab(builder, "floor", square, kerb, kerb, _earthy(rng), 5.0)
    center = (width / 2, layout.depth / 2, -0.11)
    builder.add_box(center, (width + 24.0, layout.depth + 24.0, 0.1), (0.42, 0.52, 0.32), 1.0)
    for name, low, high, z in (
        ("street", 0.0, street, 0.0),
        ("pavement", street, layout.pavement, kerb),
        ("square", layout.pavement, layout.stair_foot, kerb),
    ):
        corners = np.array([[0.0, low], [width, low], [width, high], [0.0, high]])
        builder.rooms.append(Room(name, builder.to_world(corners), z))


def _earthy(rng: np.random.Generator) -> tuple[float, float, float]:
    """Gravel, clinker or flagstones."""
    warm, light = rng.uniform(0.0, 0.16), rng.uniform(0.45, 0.75)
    return light * (1.0 + warm), light, light * (1.0 - warm)


def _build_terrace(builder: WorldBuilder, layout: Layout) -> None:
    """A raised floor with railings, open to the stairs before it and to the ramp beside it."""
    top, base, (x_low, y_low, x_high, y_high), ramp = layout.top, layout.kerb, layout.terrace, layout.ramp
    slab(builder, "floor", layout.terrace, top, top - base, STONE, 6.0)
    slab(builder, "ramp", ramp, top, top - base, (0.62, 0.60, 0.57), 6.0, layout.ramp_plane)
    start, wide = (layout.stair_x, layout.stair_foot), layout.stair_width
    rise = (top - base) / layout.steps
    build_flight(builder, start, np.pi / 2, layout.steps, rise, layout.tread, wide, base, (-1, 1), STONE)
    up, level = layout.ramp_up, (top, top)
    side, far = (x_low, x_high) if up > 0 else (x_high, x_low)
    edge = 0.05
    for a, b in (
        ((x_low + edge, y_low + edge), (start[0] - wide / 2 - 0.03, y_low + edge)),
        ((start[0] + wide / 2 + 0.03, y_low + edge), (x_high - edge, y_low + edge)),
        ((side + up * edge, y_low + edge), (side + up * edge, ramp[1])),
        ((far - up * edge, y_low + edge), (far - up * edge, y_high)),
    ):
        sloped_rail(builder, a, b, base, level)
    foot, head = (ramp[0], ramp[2]) if up > 0 else (ramp[2], ramp[0])
    sloped_rail(builder, (foot, ramp[1] + edge), (head, ramp[1] + edge), base, (base, top))
    corners = np.array([[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]])
    builder.rooms.append(Room("terrace", builder.to_world(corners), top))


def _line_kerb(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    """Cars, hedges and railings along the kerb, which is stepped over, or walked down, where they leave gaps."""
    street, kerb, at = layout.street, layout.kerb, 0.0
    for number, (x, wide) in enumerate(layout.crossings):
        barrier(builder, at, x - wide / 2, street, (0.0, kerb), rng, street > 4.6)
        at = x + wide / 2
        if number != layout.dropped:
            build_kerb(builder, x, street, wide, kerb)
            continue
        for side in (-1, 1):
            beside = x + side * (wide / 2 + 0.06)
            sloped_rail(builder, (beside, street), (beside, street + layout.drop), kerb, (kerb, kerb), 0.6)
    barrier(builder, at, layout.width, street, (0.0, kerb), rng, street > 4.6)


def _build_borders(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    """A house behind the square, one across the street or at an end, garden walls and hedges."""
    width, depth = layout.width, layout.depth
    doors = [(layout.terrace[0] + rng.uniform(0.3, 0.7) * (layout.terrace[2] - layout.terrace[0]), layout.top)]
    open_end = width - 1.0 if layout.ramp_up < 0 else 1.0
    doors.append((open_end, layout.kerb))
    build_facade(builder, (0.0, depth, width, depth + 0.4), rng.uniform(5.0, 7.5), doors, layout.top, rng)
    for x in np.arange(0.0, width - 2.0, 3.0):
        if rng.uniform() < 0.75:
            tall, hedge = rng.uniform(0.8, 2.2), rng.uniform() < 0.5
            color, texture = ((0.22, 0.42, 0.2), 35.0) if hedge else (hue(rng, (0.1, 0.35)), 9.0)
            center = (x + 1.5, -0.25, tall / 2)
            builder.add_block("hedge" if hedge else "wall", center, (rng.uniform(2.0, 3.0), 0.4, tall), color, texture)
    for x in (-0.2, width + 0.2):
        if rng.uniform() < 0.6:
            tall, low = rng.uniform(0.9, 2.4), rng.uniform(layout.street, layout.pavement)
            center = (x, (low + depth) / 2, tall / 2 + layout.kerb)
            builder.add_block("wall", center, (0.3, depth - low, tall), hue(rng, (0.1, 0.35)), 9.0)
    for x in rng.uniform(0.0, width, 4):
        tree = MAKERS["tree"](rng)
        builder.place(tree, (float(x), float(rng.uniform(-4.0, -1.5)), -0.06), 0.0)


def _furnish(builder: WorldBuilder, layout: Layout, rng: np.random.Generator) -> None:
    """Benches, trees and posts where they block no path."""
    width, street, kerb, foot = layout.width, layout.street, layout.kerb, layout.stair_foot
    half = layout.stair_width / 2 + 0.3
    free: list[Box] = [(layout.stair_x - half, foot - 1.5, layout.stair_x + half, layout.terrace[1])]
    for x, wide in layout.crossings:
        free.append((x - wide / 2 - 0.2, street - 1.4, x + wide / 2 + 0.2, street + layout.drop + 1.2))
    low, high = layout.ramp[0], layout.ramp[2]
    end = (low - 1.6, low) if layout.ramp_up > 0 else (high, high + 1.6)
    free.append((end[0], layout.ramp[1] - 0.5, end[1], layout.depth))
    pavement = (0.3, street + 0.7, width - 0.3, layout.pavement)
    square = (0.3, layout.pavement, width - 0.3, layout.terrace[1] - 0.2)
    terrace = (layout.terrace[0] + 0.2, layout.terrace[1] + 0.2, layout.terrace[2] - 0.2, layout.depth - 0.05)
    inner = (terrace[0], layout.ramp[1] - 0.4, terrace[2], terrace[3])
    stairs_head = (layout.stair_x - half, layout.terrace[1], layout.stair_x + half, layout.terrace[1] + 1.2)
    ramp_head = (terrace[2] - 1.2, *inner[1:]) if layout.ramp_up < 0 else (*inner[:2], terrace[0] + 1.2, inner[3])
    for room, z, kinds in (
        (square, kerb, SQUARE_KINDS),
        (pavement, kerb, PAVEMENT_KINDS),
        (terrace, layout.top, TERRACE_KINDS),
    ):
        plan = Plan(builder, room, z, [*free, stairs_head, ramp_head])
        for kind in kinds:
            if rng.uniform() < 0.85:
                put_somewhere(plan, kind, rng)


def put_somewhere(plan: Plan, kind: str, rng: np.random.Generator, tries: int = 12) -> None:
    """Put a piece of furniture at a random place, squarely, with room to use it from its front."""
    piece = MAKERS[kind](rng)
    x_low, y_low, x_high, y_high = plan.room
    front = FRONT_M + 0.1 if piece.seats or piece.reaches else 0.0
    for _ in range(tries):
        place = float(rng.uniform(x_low, x_high)), float(rng.uniform(y_low, y_high))
        if plan.try_place(piece, *place, int(rng.integers(4)) * np.pi / 2, front):
            return
