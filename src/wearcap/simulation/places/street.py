"""Borders of an outdoor place: house fronts, rows of barriers, ramps with their walls, kerbs to step over."""

import numpy as np

from wearcap.simulation.places import world as w
from wearcap.simulation.places.builder import WorldBuilder, hue
from wearcap.simulation.places.furnish import Box, middle_and_size
from wearcap.simulation.places.furniture import MAKERS
from wearcap.simulation.places.outline import rectangle

KERB_TREAD_M = 0.60
"""A kerb is a flight of one step; its tread sets how fast it is stepped over."""
STONE, METAL = (0.62, 0.60, 0.56), (0.28, 0.30, 0.31)
BRICK_TEXTURE = 9.0
"""Visual features per m² of masonry."""


def slab(
    builder: WorldBuilder,
    kind: str,
    box: Box,
    z: float,
    thickness: float,
    color: tuple,
    texture: float,
    plane: tuple[float, float, float] | None = None,
) -> None:
    """A rectangle of ground whose top lies at z, or on a plane (of the builder's frame)."""
    middle, size = middle_and_size(box)
    builder.add_surface(
        kind, rectangle(middle, size), color, plane=plane or (0.0, 0.0, z), texture=texture, thickness=thickness
    )


def build_kerb(builder: WorldBuilder, x: float, y: float, width: float, height: float) -> None:
    """A place at which a kerb that rises towards +y is stepped over."""
    place = builder.to_world(np.array([x, y]))
    builder.flights.append(
        w.Flight(tuple(place.tolist()), builder.heading + np.pi / 2, 1, height, KERB_TREAD_M, width, 0.0)
    )


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
    for low, high, thick, color, texture in (
        (None, 0.12, 0.10, STONE, BRICK_TEXTURE),
        (height - 0.06, height, 0.05, METAL, 6.0),
        (height / 2 - 0.02, height / 2 + 0.02, 0.03, METAL, 6.0),
    ):
        _sloped_bar(builder, (a, b), (base_z, *tops), (low, high), thick, color, texture, item)
    for share in np.linspace(0.0, 1.0, max(int(length / 1.2), 1) + 1):
        x, y = a + share * (b - a)
        top = tops[0] + share * (tops[1] - tops[0])
        builder.add_box((x, y, top + height / 2), (0.05, 0.05, height), METAL, 6.0, heading, item)


def _sloped_bar(builder, ends, heights, low_high, thick: float, color, texture: float, item: int) -> None:
    """A straight beam between two points; with `low` None it reaches down to the base."""
    (a, b), (base_z, *tops), (low, high) = ends, heights, low_high
    left = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a) * thick / 2
    ring = np.stack([a - left, b - left, b + left, a + left])
    at = np.array([tops[0], tops[1], tops[1], tops[0]])
    lower = np.full(4, base_z) if low is None else at + low
    vertices = np.concatenate(
        [np.concatenate([ring, lower[:, None]], 1), np.concatenate([ring, (at + high)[:, None]], 1)]
    )
    builder.add_prism(vertices, color, texture, item)


def barrier(
    builder: WorldBuilder,
    x_low: float,
    x_high: float,
    y: float,
    z: tuple[float, float],
    rng: np.random.Generator,
    cars: bool,
) -> None:
    """Barriers along the kerb at y (ground at z[0] before it, z[1] behind) from one x to another."""
    length = x_high - x_low
    if length < 0.15:
        return
    kind = rng.choice(["hedge", "wall", "railing", "car"], p=[0.25, 0.2, 0.2, 0.35])
    if kind == "car" and cars and length > 5.2:
        middle = rng.uniform(x_low + 2.5, x_high - 2.5)
        piece = MAKERS["car"](rng)
        builder.place(piece, (middle, y - 0.25 - piece.size[1] / 2, z[0]), float(rng.choice([0.0, np.pi])))
        half = piece.size[0] / 2 - 0.1
        barrier(builder, x_low, middle - half, y, z, rng, cars)
        barrier(builder, middle + half, x_high, y, z, rng, cars)
    elif kind in ("hedge", "wall"):
        tall, thick = (rng.uniform(0.6, 1.0), 0.55) if kind == "hedge" else (rng.uniform(0.4, 0.8), 0.30)
        color, texture = ((0.22, rng.uniform(0.36, 0.5), 0.2), 35.0) if kind == "hedge" else (STONE, BRICK_TEXTURE)
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
    middle, face = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), box[1]
    size = (box[2] - box[0], box[3] - box[1], height)
    item = builder.add_block("facade", (*middle, height / 2), size, hue(rng, (0.1, 0.4)), BRICK_TEXTURE)
    frame, glass = tuple(np.full(3, rng.uniform(0.75, 0.95)).tolist()), (0.16, 0.20, 0.25)
    wide, tall = rng.uniform(0.9, 1.3), rng.uniform(1.2, 1.6)
    sill = low_sill + rng.uniform(0.8, 1.0)
    for x in np.arange(box[0] + 1.2, box[2] - 1.0, rng.uniform(2.0, 3.0)):
        for z in np.arange(sill, height - tall, tall + 1.2):
            if z == sill and any(abs(x - door) < 1.3 for door, _ in doors):
                continue
            _opening(builder, (float(x), face, z + tall / 2), (wide, tall), frame, glass, item)
    for x, z in doors:
        _opening(builder, (x, face, z + 1.05), (1.0, 2.1), frame, hue(rng, (0.3, 0.8)), item)
        builder.add_box((x + 0.38, face - 0.07, z + 1.03), (0.12, 0.06, 0.03), METAL, 120.0, 0.0, item)
        builder.add_reach((x + 0.38, face - 0.08, z + 1.03), (x + 0.2, face - 0.55, z), np.pi / 2)


def _opening(builder, center, size: tuple[float, float], frame, pane, item: int) -> None:
    """A window or door, slightly in front of the wall."""
    x, y, z = center
    wide, tall = size
    builder.add_box((x, y - 0.01, z), (wide, 0.04, tall), pane, 8.0, 0.0, item)
    for side in (-1, 1):
        builder.add_box((x + side * wide / 2, y - 0.02, z), (0.08, 0.07, tall + 0.08), frame, 25.0, 0.0, item)
        builder.add_box((x, y - 0.02, z + side * tall / 2), (wide, 0.07, 0.08), frame, 25.0, 0.0, item)
