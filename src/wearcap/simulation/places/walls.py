"""Walls with door gaps and windows, and straight stairs with railings."""

from dataclasses import dataclass, field

import numpy as np

from wearcap.simulation.places import world as w
from wearcap.simulation.places.builder import WorldBuilder
from wearcap.simulation.places.outline import rectangle

THICKNESS = 0.12
HEIGHT = 2.5
DOOR_HEIGHT = 2.05
WINDOW = (0.9, 2.1)
"""Heights of sill and lintel above the floor (m)."""
BLANK = 0.4
"""Visual features per m² of a painted wall."""


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


def build_wall(builder: WorldBuilder, wall: Wall, color: tuple, rng: np.random.Generator) -> None:
    """Solid pieces between the openings, the wall above and below those, frames, pictures and switches."""
    openings = sorted([(*door, "door") for door in wall.doors] + [(*window, "window") for window in wall.windows])
    place = -THICKNESS / 2
    for middle, width, kind in openings:
        _panel(builder, wall, place, middle - width / 2, (0.0, HEIGHT), color)
        place = middle + width / 2
        low, high = (0.0, DOOR_HEIGHT) if kind == "door" else WINDOW
        _panel(builder, wall, middle - width / 2, place, (high, HEIGHT), color)
        if kind == "window":
            _panel(builder, wall, middle - width / 2, place, (0.0, low), color)
            sill = builder.to_world(np.array([*wall.at(middle), wall.z]))
            builder.windows.append(w.Door(tuple(sill.tolist()), builder.heading + wall.heading + np.pi / 2, width))
        _frame(builder, wall, middle, width, low, high)
        if kind == "door":
            x, y = wall.at(middle)
            door = builder.to_world(np.array([x, y, wall.z]))
            builder.doors.append(w.Door(tuple(door.tolist()), builder.heading + wall.heading + np.pi / 2, width))
            for side in (-1, 1):
                _switch(builder, wall, middle + width / 2 + 0.18, side)
    _panel(builder, wall, place, wall.length + THICKNESS / 2, (0.0, HEIGHT), color)
    for side in (-1, 1):
        _pictures(builder, wall, openings, side, rng)


def _panel(builder: WorldBuilder, wall: Wall, start: float, stop: float, z_range: tuple, color: tuple) -> None:
    if stop - start < 0.01:
        return
    x, y = wall.at((start + stop) / 2)
    tall = z_range[1] - z_range[0]
    center = (x, y, wall.z + z_range[0] + tall / 2)
    builder.add_block("wall", center, (stop - start, THICKNESS, tall), color, BLANK, wall.heading)


def _frame(builder: WorldBuilder, wall: Wall, middle: float, width: float, low: float, high: float) -> None:
    """Posts beside an opening and a bar above it, slightly in front of the wall."""
    color, z = (0.85, 0.83, 0.78), wall.z + (low + high) / 2
    for side in (-1, 1):
        x, y = wall.at(middle + side * (width / 2 + 0.03))
        builder.add_box((x, y, z), (0.06, THICKNESS + 0.03, high - low), color, 6.0, wall.heading)
    for edge in (high,) if low == 0.0 else (low, high):
        x, y = wall.at(middle)
        builder.add_box((x, y, wall.z + edge), (width + 0.12, THICKNESS + 0.03, 0.06), color, 6.0, wall.heading)


def _switch(builder: WorldBuilder, wall: Wall, distance: float, side: int) -> None:
    if distance > wall.length - 0.1:
        return
    x, y = wall.at(distance, side * (THICKNESS / 2 + 0.005))
    builder.add_box((x, y, wall.z + 1.1), (0.08, 0.01, 0.08), (0.95, 0.95, 0.95), 100.0, wall.heading)
    stand = wall.at(distance, side * (THICKNESS / 2 + 0.42))
    builder.add_reach((x, y, wall.z + 1.1), (*stand, wall.z), wall.heading - side * np.pi / 2)


def _pictures(builder: WorldBuilder, wall: Wall, openings: list, side: int, rng: np.random.Generator) -> None:
    """Prints on the wall beside the openings."""
    for distance in np.arange(0.6, wall.length - 0.6, 1.1):
        if rng.uniform() < 0.6 or any(abs(distance - middle) < width / 2 + 0.5 for middle, width, _ in openings):
            continue
        x, y = wall.at(float(distance), side * (THICKNESS / 2 + 0.01))
        size = (float(rng.uniform(0.3, 0.7)), 0.02, float(rng.uniform(0.3, 0.8)))
        builder.add_box((x, y, wall.z + 1.55), size, tuple(rng.uniform(0.2, 0.9, 3)), 150.0, wall.heading)


def build_flight(
    builder: WorldBuilder,
    start: tuple[float, float],
    direction: float,
    steps: int,
    rise: float,
    tread: float,
    width: float,
    base_z: float,
    railings: tuple[int, ...],
    color: tuple = (0.5, 0.425, 0.35),
) -> w.Flight:
    """Steps as surfaces and solid boxes; a railing on each side named (+1 left of going up, -1 right)."""
    cos, sin = np.cos(direction), np.sin(direction)
    on_line = lambda run, off: (start[0] + run * cos - off * sin, start[1] + run * sin + off * cos)  # noqa: E731
    for step in range(1, steps):
        middle, top = on_line((step - 0.5) * tread, 0.0), base_z + step * rise
        outline = rectangle(middle, (tread, width), direction)
        shade = 1.0 + 0.16 * (step % 2)
        builder.add_surface(
            "stairs_step",
            outline,
            tuple(shade * c for c in color),
            plane=(0.0, 0.0, top),
            texture=8.0,
            thickness=step * rise,
        )
        for side in railings:
            _rail(
                builder, on_line((step - 0.5) * tread, side * (width / 2 + 0.03)), tread, direction, base_z, top, step
            )
    place = builder.to_world(np.array(start))
    flight = w.Flight(tuple(place.tolist()), builder.heading + direction, steps, rise, tread, width, base_z)
    builder.flights.append(flight)
    return flight


def _rail(
    builder: WorldBuilder, middle: tuple, tread: float, heading: float, base_z: float, top: float, step: int
) -> None:
    """The side of one step: closed to the tread, open above it but for a hand rail, with a post at every third."""
    outline = rectangle(middle, (tread, 0.05), heading)
    item = builder.add_object("railing", outline, (base_z, top + 0.9), (*middle, base_z), heading)
    color = (0.45, 0.35, 0.25)
    builder.add_box((*middle, (base_z + top + 0.1) / 2), (tread, 0.05, top + 0.1 - base_z), color, 3.0, heading, item)
    builder.add_box((*middle, top + 0.87), (tread, 0.05, 0.06), color, 3.0, heading, item)
    if step % 3 == 1:
        builder.add_box((*middle, top + 0.45), (0.05, 0.05, 0.9), color, 3.0, heading, item)


def build_railing(builder: WorldBuilder, start: tuple, end: tuple, z: float) -> None:
    """A level railing along an edge: a hand rail on posts."""
    wall = Wall(start, end, z)
    if wall.length < 0.1:
        return
    middle, color = wall.at(wall.length / 2), (0.45, 0.35, 0.25)
    outline = rectangle(middle, (wall.length, 0.06), wall.heading)
    item = builder.add_object("railing", outline, (z, z + 0.95), (*middle, z), wall.heading)
    for height in (0.92, 0.5, 0.1):
        builder.add_box((*middle, z + height), (wall.length, 0.05, 0.05), color, 3.0, wall.heading, item)
    for distance in np.linspace(0.03, wall.length - 0.03, max(int(wall.length / 0.8), 1) + 1):
        builder.add_box((*wall.at(float(distance)), z + 0.46), (0.05, 0.05, 0.92), color, 3.0, wall.heading, item)
