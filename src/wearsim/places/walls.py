"""Borders of a place: walls with doors and windows, stairs, railings, house fronts, and barriers along a kerb."""

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from wearsim.places import world as w
from wearsim.places.builder import Color, WorldBuilder, hue
from wearsim.places.furniture import MAKERS
from wearsim.places.outline import Box, middle_and_size, rectangle

THICKNESS = 0.12
HEIGHT = 2.5
DOOR_HEIGHT = 2.05
WINDOW = (0.9, 2.1)
"""Heights of sill and lintel above the floor (m)."""
BLANK, MASONRY = 0.4, 9.0
"""Visual features per m² of a painted wall, and of masonry."""
KERB_TREAD_M = 0.60
"""A kerb is a flight of one step; its tread sets how fast it is stepped over."""
STONE, METAL, WOODEN = (0.62, 0.60, 0.56), (0.28, 0.30, 0.31), (0.45, 0.35, 0.25)


@dataclass
class Wall:
    """An upright wall between two points of the builder's plane; openings are (distance from start, width)."""

    start: tuple[float, float]
    end: tuple[float, float]
    z: float = 0.0
    doors: list[tuple[float, float]] = field(default_factory=list)
    windows: list[tuple[float, float]] = field(default_factory=list)

    @property
    def length(self) -> float:
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def heading(self) -> float:
        return float(np.arctan2(self.end[1] - self.start[1], self.end[0] - self.start[0]))

    def at(self, distance: float, off: float = 0.0) -> tuple[float, float]:
        """Point at a distance along the wall, `off` metres to its left."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return (float(self.start[0] + distance * cos - off * sin), float(self.start[1] + distance * sin + off * cos))

    def build(self, builder: WorldBuilder, color: Color, rng: np.random.Generator) -> None:
        """Solid pieces between the openings, the wall above and below those, frames, pictures and switches."""
        openings = sorted([(*door, True) for door in self.doors] + [(*window, False) for window in self.windows])
        place = -THICKNESS / 2
        for middle, width, is_door in openings:
            start, stop = middle - width / 2, middle + width / 2
            low, high = (0.0, DOOR_HEIGHT) if is_door else WINDOW
            self.add_panel(builder, (place, start), (0.0, HEIGHT), color)
            self.add_panel(builder, (start, stop), (high, HEIGHT), color)
            if not is_door:
                self.add_panel(builder, (start, stop), (0.0, low), color)
            gap = w.Door(builder.point(*self.at(middle), self.z), builder.heading + self.heading + np.pi / 2, width)
            (builder.places.doors if is_door else builder.windows).append(gap)
            edges = [(middle + side * (width / 2 + 0.03), (low + high) / 2, 0.06, high - low) for side in (-1, 1)]
            edges += [(middle, edge, width + 0.12, 0.06) for edge in ((high,) if is_door else (low, high))]
            for along, z, long, tall in edges:  # posts and bars of the frame, slightly in front of the wall
                center, size = (*self.at(along), self.z + z), (long, THICKNESS + 0.03, tall)
                builder.add_box(center, size, (0.85, 0.83, 0.78), 6.0, self.heading)
            place, along = stop, stop + 0.18
            for side in (-1, 1) if is_door and along <= self.length - 0.1 else ():
                switch = (*self.at(along, side * (THICKNESS / 2 + 0.005)), self.z + 1.1)
                builder.add_box(switch, (0.08, 0.01, 0.08), (0.95, 0.95, 0.95), 100.0, self.heading)
                stand = (*self.at(along, side * (THICKNESS / 2 + 0.42)), self.z)
                builder.add_reach(switch, stand, self.heading - side * np.pi / 2)
        self.add_panel(builder, (place, self.length + THICKNESS / 2), (0.0, HEIGHT), color)
        for side, distance in product((-1, 1), np.arange(0.6, self.length - 0.6, 1.1)):
            if rng.uniform() < 0.6 or any(abs(distance - middle) < width / 2 + 0.5 for middle, width, _ in openings):
                continue
            picture = (*self.at(float(distance), side * (THICKNESS / 2 + 0.01)), self.z + 1.55)
            size = (float(rng.uniform(0.3, 0.7)), 0.02, float(rng.uniform(0.3, 0.8)))
            builder.add_box(picture, size, tuple(rng.uniform(0.2, 0.9, 3)), 150.0, self.heading)

    def add_panel(self, builder: WorldBuilder, span: tuple, z_range: tuple, color: Color) -> None:
        """A solid piece over a span along the wall and a range of heights (m); none where it would be very narrow."""
        if span[1] - span[0] < 0.01:
            return
        tall = z_range[1] - z_range[0]
        center = (*self.at((span[0] + span[1]) / 2), self.z + z_range[0] + tall / 2)
        builder.add_block("wall", center, (span[1] - span[0], THICKNESS, tall), color, BLANK, self.heading)


def before_gap(builder: WorldBuilder, gap: w.Door, deep: float = 0.95, beside: float = 0.15) -> Box:
    """The floor on both sides of a door or window, `deep` and its width with a margin `beside` (m)."""
    x, y = builder.from_world(np.array(gap.position[:2]))
    along = abs(np.cos(gap.heading - builder.heading)) > 0.5
    half_x, half_y = (deep, gap.width / 2 + beside) if along else (gap.width / 2 + beside, deep)
    return (x - half_x, y - half_y, x + half_x, y + half_y)


def build_flight(
    builder: WorldBuilder, flight: w.Flight, railings: tuple[int, ...] = (-1, 1), color: Color = (0.5, 0.425, 0.35)
) -> None:
    """Stairs, given in the builder's frame, as surfaces and solid boxes.

    They have a railing on each side named (+1 left of going up, -1 right): closed to the tread, open above it but for a
    hand rail, with a post at every third step.
    """
    tread, width, heading, base = flight.tread, flight.width, flight.direction, flight.base_z
    (x, y), cos, sin = flight.start, np.cos(heading), np.sin(heading)
    on_line = lambda run, off: (x + run * cos - off * sin, y + run * sin + off * cos)  # noqa: E731
    for step in range(1, flight.steps):
        along, top = (step - 0.5) * tread, base + step * flight.rise
        outline = rectangle(on_line(along, 0.0), (tread, width), heading)
        shaded = tuple((1.0 + 0.16 * (step % 2)) * c for c in color)
        plane, thickness = (0.0, 0.0, top), step * flight.rise
        builder.add_surface("stairs_step", outline, shaded, plane=plane, texture=8.0, thickness=thickness)
        for side in railings:
            middle = on_line(along, side * (width / 2 + 0.03))
            edge = rectangle(middle, (tread, 0.05), heading)
            item = builder.add_object("railing", edge, (base, top + 0.9), (*middle, base), heading)
            bars = [((base + top + 0.1) / 2, tread, top + 0.1 - base), (top + 0.87, tread, 0.06)]
            if step % 3 == 1:
                bars.append((top + 0.45, 0.05, 0.9))
            for z, long, tall in bars:
                builder.add_box((*middle, z), (long, 0.05, tall), WOODEN, 3.0, heading, item)
    builder.places.flights.append(
        replace(flight, start=builder.point(*flight.start), direction=builder.heading + heading)
    )


def build_railing(builder: WorldBuilder, start: tuple, end: tuple, z: float) -> None:
    """A level railing along an edge: a hand rail on posts."""
    wall = Wall(start, end, z)
    if wall.length < 0.1:
        return
    middle = wall.at(wall.length / 2)
    outline = rectangle(middle, (wall.length, 0.06), wall.heading)
    item = builder.add_object("railing", outline, (z, z + 0.95), (*middle, z), wall.heading)
    for height in (0.92, 0.5, 0.1):
        builder.add_box((*middle, z + height), (wall.length, 0.05, 0.05), WOODEN, 3.0, wall.heading, item)
    for distance in np.linspace(0.03, wall.length - 0.03, max(int(wall.length / 0.8), 1) + 1):
        builder.add_box((*wall.at(float(distance)), z + 0.46), (0.05, 0.05, 0.92), WOODEN, 3.0, wall.heading, item)


def sloped_rail(
    builder: WorldBuilder,
    start: tuple[float, float],
    end: tuple[float, float],
    base_z: float,
    tops: tuple[float, float],
    height: float = 0.9,
) -> None:
    """A wall beside a slope whose ground is at `tops` (m) at its two ends, low, with a hand rail on posts."""
    a, b = np.array(start), np.array(end)
    length, heading = float(np.linalg.norm(b - a)), float(np.arctan2(*(b - a)[::-1]))
    outline = rectangle(tuple((a + b) / 2), (length, 0.10), heading)
    item = builder.add_object("railing", outline, (base_z, max(tops) + height), (*start, base_z), heading)
    ground = np.array([tops[0], tops[1], tops[1], tops[0]])
    for lower, high, thick, color, texture in (
        (np.full(4, base_z), 0.12, 0.10, STONE, MASONRY),
        (ground + (height - 0.06), height, 0.05, METAL, 6.0),
        (ground + (height / 2 - 0.02), height / 2 + 0.02, 0.03, METAL, 6.0),
    ):
        left = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a) * thick / 2
        ring = np.stack([a - left, b - left, b + left, a + left])
        rings = [np.concatenate([ring, z[:, None]], 1) for z in (lower, ground + high)]
        builder.add_prism(np.concatenate(rings), color, texture, item)
    for share in np.linspace(0.0, 1.0, max(int(length / 1.2), 1) + 1):
        x, y = a + share * (b - a)
        top = tops[0] + share * (tops[1] - tops[0])
        builder.add_box((x, y, top + height / 2), (0.05, 0.05, height), METAL, 6.0, heading, item)


def barrier(
    builder: WorldBuilder,
    span: tuple[float, float],
    y: float,
    z: tuple[float, float],
    rng: np.random.Generator,
    cars: bool,
) -> None:
    """Barriers along the kerb at y (ground at z[0] before it, z[1] behind) over a span of x."""
    x_low, x_high = span
    length = x_high - x_low
    if length < 0.15:
        return
    kind = rng.choice(["hedge", "wall", "railing", "car"], p=[0.25, 0.2, 0.2, 0.35])
    if kind == "car" and cars and length > 5.2:
        middle = rng.uniform(x_low + 2.5, x_high - 2.5)
        piece = MAKERS["car"](rng)
        builder.place(piece, (middle, y - 0.25 - piece.size[1] / 2, z[0]), float(rng.choice([0.0, np.pi])))
        half = piece.size[0] / 2 - 0.1
        barrier(builder, (x_low, middle - half), y, z, rng, cars)
        barrier(builder, (middle + half, x_high), y, z, rng, cars)
    elif kind in ("hedge", "wall"):
        tall, thick = (rng.uniform(0.6, 1.0), 0.55) if kind == "hedge" else (rng.uniform(0.4, 0.8), 0.30)
        color, texture = ((0.22, rng.uniform(0.36, 0.5), 0.2), 35.0) if kind == "hedge" else (STONE, MASONRY)
        center = ((x_low + x_high) / 2, y + 0.02 + thick / 2, z[1] + tall / 2)
        builder.add_block("hedge" if kind == "hedge" else "low_wall", center, (length, thick, tall), color, texture)
    else:
        sloped_rail(builder, (x_low, y + 0.08), (x_high, y + 0.08), z[1], (z[1], z[1]), rng.uniform(0.8, 1.0))


def build_facade(
    builder: WorldBuilder,
    box: Box,
    height: float,
    doors: list[tuple[float, float]],
    low_sill: float,
    rng: np.random.Generator,
) -> None:
    """A house front whose face is the box's lower y, with windows in rows and doors at (x, sill height)."""
    (middle, size), face = middle_and_size(box), box[1]
    item = builder.add_block("facade", (*middle, height / 2), (*size, height), hue(rng, (0.1, 0.4)), MASONRY)
    frame, glass = tuple(np.full(3, rng.uniform(0.75, 0.95)).tolist()), (0.16, 0.20, 0.25)
    wide, tall = rng.uniform(0.9, 1.3), rng.uniform(1.2, 1.6)
    sill = low_sill + rng.uniform(0.8, 1.0)

    def add_opening(x: float, z: float, wide: float, tall: float, pane: Color) -> None:
        """A window or door, slightly in front of the wall."""
        builder.add_box((x, face - 0.01, z), (wide, 0.04, tall), pane, 8.0, 0.0, item)
        for side in (-1, 1):
            builder.add_box((x + side * wide / 2, face - 0.02, z), (0.08, 0.07, tall + 0.08), frame, 25.0, 0.0, item)
            builder.add_box((x, face - 0.02, z + side * tall / 2), (wide, 0.07, 0.08), frame, 25.0, 0.0, item)

    for x in np.arange(box[0] + 1.2, box[2] - 1.0, rng.uniform(2.0, 3.0)):
        for z in np.arange(sill, height - tall, tall + 1.2):
            if z != sill or all(abs(x - door) >= 1.3 for door, _ in doors):
                add_opening(float(x), z + tall / 2, wide, tall, glass)
    for x, z in doors:
        add_opening(x, z + 1.05, 1.0, 2.1, hue(rng, (0.3, 0.8)))
        builder.add_box((x + 0.38, face - 0.07, z + 1.03), (0.12, 0.06, 0.03), METAL, 120.0, 0.0, item)
        builder.add_reach((x + 0.38, face - 0.08, z + 1.03), (x + 0.2, face - 0.55, z), np.pi / 2)
