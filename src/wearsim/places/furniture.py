"""Furniture and outdoor objects: each maker draws sizes and colours and returns a Piece (front +x).

To add a kind, write a maker and enter it in `MAKERS`; rooms and gardens ask for pieces by kind. Parts are rows of
their middle and size (m), colour, texture and, for a column, its number of sides. A `Plan` puts pieces into a rectangle
of floor so that they overlap nothing, block no door and are usable from their front.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from wearsim.places.builder import Color, Part, Piece, WorldBuilder, entered, hue
from wearsim.places.outline import Box, overlaps

PATTERNED, PLAIN, PRINTED = 40.0, 4.0, 120.0
"""Visual features per m² of leaves and handles, of painted or upholstered surfaces, and of book spines and prints."""
WOOD: Color = (0.55, 0.40, 0.26)
DARK, GRAY, IRON = (0.1, 0.1, 0.12), (0.3, 0.3, 0.3), (0.3, 0.3, 0.32)
BOTH = (-1, 1)

FRONT_M = 0.8
"""Free space in front of seats and of furniture that one reaches into."""
TRIES = 12

ROOM_KINDS: dict[str, tuple[str, ...]] = {
    "living room": ("sofa", "cabinet", "shelf", "armchair", "plant", "lamp", "shelf"),
    "bedroom": ("bed", "wardrobe", "desk", "shelf", "lamp", "plant"),
    "kitchen": ("counter", "shelf", "cabinet", "plant"),
    "study": ("desk", "shelf", "armchair", "shelf", "cabinet", "lamp"),
}
"""Furniture along the walls of each kind of room, in order of preference."""

TABLES = {
    "table": ((0.75, 0.95), (1.1, 1.9), (0.72, 0.76)),
    "desk": ((0.6, 0.75), (1.2, 1.6), (0.72, 0.76)),
    "coffee_table": ((0.5, 0.7), (0.8, 1.2), (0.38, 0.46)),
}
"""Ranges of depth, width and height of each kind of table (m)."""
HAS_TABLE = ("living room", "kitchen")

MAKERS: dict[str, Callable[[np.random.Generator], Piece]] = {}
"""Makers by kind of piece."""


def wood(rng: np.random.Generator) -> Color:
    """A random colour of wood."""
    shade = rng.uniform(0.6, 1.35)
    red, green, blue = (min(shade * c, 1.0) for c in WOOD)
    return red, green, blue


def parts_of(rows: Iterable[tuple]) -> tuple[Part, ...]:
    """Parts of rows: middle (3), size (3), colour, texture and, for a column, its number of sides."""
    return tuple(Part(row[:3], row[3:6], *row[6:]) for row in rows)


def _legs(depth: float, width: float, height: float, thick: float, color: Color) -> list[tuple]:
    """Rows of four legs below the corners of an outline (m)."""
    corners = [(x * (depth - thick) / 2, y * (width - thick) / 2) for x in BOTH for y in BOTH]
    return [(x, y, height / 2, thick, thick, height, color, 8.0) for x, y in corners]


@entered(MAKERS, "chair")
def _chair(rng: np.random.Generator) -> Piece:
    depth, width, seat = rng.uniform(0.40, 0.46), rng.uniform(0.40, 0.46), rng.uniform(0.43, 0.47)
    color, back = wood(rng), rng.uniform(0.82, 0.95)
    rows = [
        *_legs(depth, width, seat - 0.03, 0.04, color),
        (0, 0, seat - 0.02, depth, width, 0.04, hue(rng), 12.0),
        (-depth / 2 + 0.02, 0, (seat + back) / 2, 0.03, width, back - seat, color, 8.0),
    ]
    return Piece("chair", (depth, width), (0.0, back), parts_of(rows), seats=((0.0, 0.0, seat, 0.0, depth / 2),))


@entered(MAKERS, "armchair", "sofa")
def _upholstered(rng: np.random.Generator, kind: str) -> Piece:
    places = 1 if kind == "armchair" else int(rng.integers(2, 4))
    depth, arm, seat = rng.uniform(0.80, 0.90), 0.16, rng.uniform(0.42, 0.46)
    inner, color = 0.62 * places, hue(rng)
    width = inner + 2 * arm
    middles = [(k - (places - 1) / 2) * 0.62 for k in range(places)]
    cushions = (
        (-depth / 2 + 0.28, y, seat + 0.2, 0.1, 0.4, 0.36, hue(rng), PATTERNED) for y in middles if rng.uniform() < 0.6
    )
    rows = [
        (0, 0, seat / 2 + 0.03, depth, width, seat - 0.06, color, PLAIN),
        (-depth / 2 + 0.12, 0, 0.62, 0.22, width, 0.46, color, PLAIN),
        *((0, side * (width - arm) / 2, 0.31, depth, arm, 0.62, color, PLAIN) for side in BOTH),
        *cushions,
    ]
    seats = tuple((depth / 2 - 0.24, y, seat, 0.0, 0.24) for y in middles)
    return Piece(kind, (depth, width), (0.0, 0.85), parts_of(rows), seats=seats)


@entered(MAKERS, "bed")
def _bed(rng: np.random.Generator) -> Piece:
    """A bed; its front, where one sits down, is a long side."""
    width, length, top = rng.uniform(1.0, 1.8), 2.05, rng.uniform(0.43, 0.50)
    cover = hue(rng)
    rows = [
        (0, 0, (top - 0.2) / 2, width, length, top - 0.2, wood(rng), PLAIN),
        (0, 0, top - 0.1, width - 0.04, length - 0.04, 0.2, cover, 10.0),
        (0, length / 2 - 0.02, 0.5, width, 0.05, 1.0, wood(rng), PLAIN),
        (0, length / 2 - 0.3, top + 0.06, width * 0.7, 0.4, 0.12, hue(rng, (0.0, 0.2)), 10.0),
    ]
    seats = ((width / 2 - 0.22, -0.3, top, 0.0, 0.22),)
    return Piece("bed", (width, length), (0.0, 1.0), parts_of(rows), seats=seats)


@entered(MAKERS, *TABLES)
def _laid_table(rng: np.random.Generator, kind: str) -> Piece:
    """A table with props on it, a desk also with a screen; its first five parts are the legs and the top."""
    depth, width, top = (rng.uniform(*span) for span in TABLES[kind])
    color = wood(rng)
    rows = [
        *_legs(depth - 0.06, width - 0.06, top - 0.04, 0.06, color),
        (0, 0, top - 0.02, depth, width, 0.04, color, PLAIN),
    ]
    props = [_prop(rng, (rng.uniform(0.0, depth / 2 - 0.12), y, top)) for y in _spread(rng, width - 0.3, 3)]
    reaches = tuple((p.center[0], p.center[1], top + p.size[2] * 0.7) for p in props)
    high = top
    if kind == "desk":
        props.append(Part((-depth / 4, 0, top + 0.28), (0.03, 0.55, 0.34), DARK, 30.0))
        high += 0.45
    return Piece(kind, (depth, width), (0.0, high), (*parts_of(rows), *props), reaches=reaches)


@entered(MAKERS, "shelf")
def _shelf(rng: np.random.Generator) -> Piece:
    """Boards between two sides, with blocks of book spines on them."""
    depth, width, height = rng.uniform(0.28, 0.36), rng.uniform(0.6, 1.6), rng.uniform(1.2, 2.1)
    color, boards = wood(rng), int(rng.integers(3, 6))
    rows: list[tuple] = [
        *((0, side * (width - 0.03) / 2, height / 2, depth, 0.03, height, color, PLAIN) for side in BOTH),
        (-depth / 2 + 0.01, 0, height / 2, 0.015, width, height, color, PLAIN),
    ]
    levels = np.linspace(0.08, height - 0.02, boards + 1)
    for z, above in zip(levels, np.append(levels[1:], np.nan)):
        rows.append((0, 0, z, depth, width - 0.04, 0.025, color, PLAIN))
        y = -width / 2 + 0.05
        while np.isfinite(above) and y < width / 2 - 0.2:
            run, tall = rng.uniform(0.08, 0.25), min(rng.uniform(0.16, 0.30), above - z - 0.05)
            if rng.uniform() < 0.75:
                rows.append((0.0, y + run / 2, z + 0.0125 + tall / 2, depth - 0.08, run, tall, hue(rng), PRINTED))
            y += run + rng.uniform(0.0, 0.08)
    reaches = tuple((depth / 2 - 0.03, rng.uniform(-0.3, 0.3) * width, z + 0.14) for z in levels[:-1] if 0.3 < z < 1.75)
    return Piece("shelf", (depth, width), (0.0, height), parts_of(rows), reaches=reaches)


@entered(MAKERS, "wardrobe")
def _wardrobe(rng: np.random.Generator) -> Piece:
    depth, width, height = 0.6, rng.uniform(0.9, 1.8), rng.uniform(1.9, 2.2)
    handles = tuple((depth / 2 + 0.015, side * 0.05, 1.05) for side in BOTH)
    rows = [
        (0, 0, height / 2, depth, width, height, wood(rng), 2.0),
        *((*handle, 0.03, 0.02, 0.18, GRAY, PATTERNED) for handle in handles),
    ]
    return Piece("wardrobe", (depth, width), (0.0, height), parts_of(rows), reaches=handles)


@entered(MAKERS, "cabinet")
def _cabinet(rng: np.random.Generator) -> Piece:
    """A low cabinet, with a screen or props on top."""
    depth, width, height = rng.uniform(0.38, 0.45), rng.uniform(1.0, 1.7), rng.uniform(0.45, 0.85)
    rows, props, top = [(0, 0, height / 2, depth, width, height, wood(rng), 3.0)], [], height
    if rng.uniform() < 0.5:
        tall = rng.uniform(0.5, 0.7)
        rows.append((0, 0, height + 0.05 + tall / 2, 0.05, min(1.2, width), tall, (0.08, 0.08, 0.1), 1.0))
        top += 0.05 + tall
    else:
        props = [_prop(rng, (0.0, y, height)) for y in _spread(rng, width - 0.2, 3)]
    reaches = ((depth / 2, 0.2, height - 0.1), (depth / 2, -0.2, height - 0.25))
    return Piece("cabinet", (depth, width), (0.0, top), (*parts_of(rows), *props), reaches=reaches)


@entered(MAKERS, "counter")
def _kitchen_counter(rng: np.random.Generator) -> Piece:
    """A kitchen counter: worktop with props on it, cupboards above."""
    width, color = rng.uniform(1.6, 2.8), hue(rng, (0.0, 0.35))
    handles = np.arange(-width / 2 + 0.3, width / 2, 0.6)
    rows = [
        (-0.02, 0, 0.43, 0.56, width, 0.86, color, 5.0),
        (0, 0, 0.89, 0.62, width, 0.04, (0.35, 0.33, 0.32), 12.0),
        (-0.14, 0, 1.75, 0.34, width, 0.65, color, 5.0),
        *((0.27, y, 0.78, 0.02, 0.14, 0.02, (0.7, 0.7, 0.7), PATTERNED) for y in handles),
    ]
    props = [_prop(rng, (rng.uniform(-0.15, 0.2), y, 0.91)) for y in _spread(rng, width - 0.3, 5)]
    reaches = [(p.center[0], p.center[1], 0.91 + p.size[2] * 0.7) for p in props]
    reaches += [(0.05, y, 1.5) for y in _spread(rng, width - 0.6, 2)]
    return Piece("counter", (0.62, width), (0.0, 2.08), (*parts_of(rows), *props), reaches=tuple(reaches))


@entered(MAKERS, "plant")
def _plant(rng: np.random.Generator) -> Piece:
    pot, height = rng.uniform(0.25, 0.38), rng.uniform(0.5, 1.3)
    green, wide = (0.2, rng.uniform(0.35, 0.6), 0.2), pot * 1.5
    rows = [
        (0, 0, 0.16, pot, 0, 0.32, hue(rng), 8.0, 8),
        (0, 0, 0.3 + height / 2, wide, 0, height, green, PATTERNED, 7),
    ]
    return Piece("plant", (wide, wide), (0.0, 0.3 + height), parts_of(rows))


@entered(MAKERS, "lamp")
def _lamp(rng: np.random.Generator) -> Piece:
    height = rng.uniform(1.4, 1.8)
    rows = [
        (0, 0, 0.015, 0.3, 0, 0.03, (0.2, 0.2, 0.2), PLAIN, 8),
        (0, 0, height / 2, 0.03, 0, height, GRAY, PLAIN, 6),
        (0, 0, height, 0.36, 0, 0.25, (0.95, 0.9, 0.75), 8.0, 8),
    ]
    return Piece("lamp", (0.36, 0.36), (0.0, height + 0.13), parts_of(rows), reaches=((0.1, 0.0, height - 0.25),))


@entered(MAKERS, "bench")
def _bench(rng: np.random.Generator) -> Piece:
    width, seat, color = rng.uniform(1.3, 1.9), rng.uniform(0.43, 0.46), wood(rng)
    rows = [
        (0.0, 0, seat - 0.025, 0.44, width, 0.05, color, 15.0),
        (-0.2, 0, seat + 0.25, 0.04, width, 0.35, color, 15.0),
        *((0.0, side * (width / 2 - 0.15), seat / 2 - 0.025, 0.4, 0.08, seat - 0.05, IRON) for side in BOTH),
    ]
    seats = tuple((0.0, y, seat, 0.0, 0.22) for y in (-width / 4, width / 4))
    return Piece("bench", (0.46, width), (0.0, seat + 0.43), parts_of(rows), seats=seats)


@entered(MAKERS, "tree")
def _tree(rng: np.random.Generator) -> Piece:
    trunk, height, crown = rng.uniform(0.2, 0.5), rng.uniform(1.9, 2.6), rng.uniform(1.6, 3.2)
    green = (0.15, rng.uniform(0.35, 0.55), 0.15)
    rows = [
        (0, 0, height / 2, trunk, 0, height, (0.35, 0.26, 0.18), PATTERNED, 8),
        (0, 0, height + crown * 0.2, crown, 0, crown * 0.4, green, 30.0, 9),
        (0, 0, height + crown * 0.5, crown * 0.7, 0, crown * 0.4, green, 30.0, 7),
    ]
    return Piece("tree", (trunk, trunk), (0.0, height), parts_of(rows))


@entered(MAKERS, "bush")
def _bush(rng: np.random.Generator) -> Piece:
    size, height = rng.uniform(0.5, 1.2), rng.uniform(0.5, 1.2)
    rows = [(0, 0, height / 2, size, 0, height, (0.2, rng.uniform(0.35, 0.55), 0.2), PATTERNED, 8)]
    return Piece("bush", (size * 0.9, size * 0.9), (0.0, height), parts_of(rows))


@entered(MAKERS, "street_lamp")
def _street_lamp(rng: np.random.Generator) -> Piece:
    height = rng.uniform(3.5, 4.5)
    rows = [
        (0, 0, height / 2, 0.12, 0, height, (0.25, 0.28, 0.28), 8.0, 8),
        (0.2, 0, height, 0.6, 0.2, 0.12, (0.4, 0.4, 0.4), 8.0),
    ]
    return Piece("street_lamp", (0.14, 0.14), (0.0, height), parts_of(rows))


@entered(MAKERS, "bin")
def _bin(rng: np.random.Generator) -> Piece:
    size, height = rng.uniform(0.35, 0.6), rng.uniform(0.8, 1.1)
    rows = [(0, 0, height / 2, size, size, height, hue(rng), 15.0)]
    return Piece("bin", (size, size), (0.0, height), parts_of(rows), reaches=((size / 2 - 0.05, 0.0, height),))


@entered(MAKERS, "low_wall")
def _low_wall(rng: np.random.Generator) -> Piece:
    """A low wall to sit on or walk around; its front is a long side."""
    depth, width, height = rng.uniform(0.36, 0.45), rng.uniform(1.4, 2.6), rng.uniform(0.42, 0.47)
    rows = [
        (0, 0, height / 2 - 0.03, depth - 0.06, width - 0.06, height - 0.06, (0.55, 0.42, 0.36), 20.0),
        (0, 0, height - 0.03, depth, width, 0.06, (0.70, 0.69, 0.66), 12.0),
    ]
    seat = (depth / 2 - 0.22, float(rng.uniform(-0.25, 0.25)) * width, height, 0.0, 0.22)
    return Piece("low_wall", (depth, width), (0.0, height), parts_of(rows), seats=(seat,))


@entered(MAKERS, "planter")
def _planter(rng: np.random.Generator) -> Piece:
    depth, width, height = rng.uniform(0.5, 0.8), rng.uniform(0.8, 1.6), rng.uniform(0.45, 0.7)
    green, tall = (0.2, rng.uniform(0.4, 0.6), 0.2), rng.uniform(0.25, 0.6)
    rows = [
        (0, 0, height / 2, depth, width, height, (0.62, 0.60, 0.57), 10.0),
        (0, 0, height + tall / 2, depth - 0.1, width - 0.1, tall, green, PATTERNED),
    ]
    return Piece("planter", (depth, width), (0.0, height + tall), parts_of(rows))


@entered(MAKERS, "bollard")
def _bollard(rng: np.random.Generator) -> Piece:
    thick, height = rng.uniform(0.10, 0.18), rng.uniform(0.85, 1.05)
    rows = [
        (0, 0, height / 2, thick, 0, height, (0.22, 0.24, 0.26), 10.0, 8),
        (0, 0, height - 0.12, thick + 0.01, 0, 0.08, (0.85, 0.85, 0.8), PATTERNED, 8),
    ]
    return Piece("bollard", (thick, thick), (0.0, height), parts_of(rows))


@entered(MAKERS, "board")
def _notice_board(rng: np.random.Generator) -> Piece:
    """A notice board or map on two posts, pointed at from the front."""
    width, low, tall = rng.uniform(0.9, 1.4), rng.uniform(0.85, 1.0), rng.uniform(0.7, 1.0)
    high = low + tall
    rows = [
        *((-0.03, side * (width / 2 - 0.06), high / 2, 0.06, 0.06, high, IRON, 8.0) for side in BOTH),
        (0.02, 0, low + tall / 2, 0.04, width, tall, hue(rng, (0.05, 0.4)), PRINTED),
    ]
    reaches = tuple((0.04, float(y), low + rng.uniform(0.15, 0.9) * tall) for y in (-0.2, 0.1, 0.3))
    return Piece("board", (0.12, width), (0.0, high), parts_of(rows), reaches=reaches)


@entered(MAKERS, "letter_box")
def _letter_box(rng: np.random.Generator) -> Piece:
    color, slot = hue(rng, (0.7, 0.9)), rng.uniform(1.15, 1.35)
    rows = [
        (0, 0, 0.4, 0.12, 0.12, 0.8, GRAY, PLAIN),
        (0, 0, 1.15, 0.32, 0.42, 0.75, color, 12.0),
        (0.165, 0, slot, 0.02, 0.28, 0.05, (0.1, 0.1, 0.1), PRINTED),
    ]
    return Piece("letter_box", (0.34, 0.42), (0.0, 1.53), parts_of(rows), reaches=((0.17, 0.0, slot),))


@entered(MAKERS, "car")
def _car(rng: np.random.Generator) -> Piece:
    """A parked car; its front is the bonnet."""
    length, width, color = rng.uniform(3.8, 4.5), rng.uniform(1.68, 1.80), hue(rng, (0.0, 0.8))
    cabin, wheel, tyre = 0.52 * length, width / 2 - 0.1, (0.08, 0.08, 0.08)
    rows = [
        (0, 0, 0.52, length, width, 0.55, color, 5.0),
        (-0.06 * length, 0, 1.10, cabin, width - 0.22, 0.60, (0.12, 0.14, 0.17), 8.0),
        (-0.06 * length, 0, 1.43, cabin - 0.1, width - 0.26, 0.06, color, PLAIN),
        *((x * 0.32 * length, y * wheel, 0.31, 0.60, 0.21, 0.60, tyre, 20.0) for x in BOTH for y in BOTH),
        *((length / 2, y * (width / 2 - 0.25), 0.65, 0.04, 0.35, 0.14, (0.9, 0.9, 0.85), 60.0) for y in BOTH),
    ]
    return Piece("car", (length, width), (0.0, 1.46), parts_of(rows))


def _prop(rng: np.random.Generator, base: tuple[float, float, float]) -> Part:
    """A mug, box or vase that stands on something at `base`."""
    wide, tall = rng.uniform(0.07, 0.2), rng.uniform(0.08, 0.28)
    center = (float(base[0]), float(base[1]), base[2] + tall / 2)
    return Part(center, (wide, wide, tall), hue(rng), PRINTED, int(rng.choice([4, 8])))


def _spread(rng: np.random.Generator, width: float, most: int) -> np.ndarray:
    """Up to `most` places across a width, apart from each other."""
    count = int(rng.integers(1, most + 1))
    slots = (np.arange(count) + 0.5) / count - 0.5
    return slots * width + rng.uniform(-0.25, 0.25, count) * width / count


@dataclass
class Plan:
    """A rectangle of floor that is being filled."""

    builder: WorldBuilder
    room: Box
    z: float
    kept_free: list[Box] = field(default_factory=list)
    solid: list[Box] = field(default_factory=list)

    def try_place(self, piece: Piece, x: float, y: float, heading: float, front: float = 0.0) -> bool:
        """Place a piece if it fits with `front` metres free before it; returns whether it did."""
        outline = _outline(piece.size, x, y, heading)
        ahead = _outline((front, piece.size[1]), *_ahead(x, y, heading, (piece.size[0] + front) / 2), heading)
        fits = _inside(outline, self.room) and (not front or _inside(ahead, self.room))
        fits = fits and not any(overlaps(outline, other, 0.05) for other in (*self.solid, *self.kept_free))
        if not fits or (front and any(overlaps(ahead, other) for other in self.solid)):
            return False
        self.builder.place(piece, (x, y, self.z), heading)
        self.solid.append(outline)
        if front:
            self.kept_free.append(ahead)
        return True

    def against_wall(self, piece: Piece, rng: np.random.Generator, front: float | None = None) -> tuple | None:
        """Put a piece with its back to a random wall; returns (x, y, heading), or None where nothing fits.

        Without `front`, pieces used from their front have `FRONT_M` free before it.
        """
        if front is None:
            front = FRONT_M if piece.has_front else 0.0
        depth, width = piece.size[0] / 2 + 0.02, piece.size[1] / 2 + 0.02
        x_low, y_low, x_high, y_high = self.room
        for _ in range(TRIES):
            side = int(rng.integers(4))
            along = (y_low, y_high) if side % 2 == 0 else (x_low, x_high)
            if along[1] - along[0] <= 2 * width:
                continue
            place = rng.uniform(along[0] + width, along[1] - width)
            backs = [(x_low + depth, place), (place, y_low + depth), (x_high - depth, place), (place, y_high - depth)]
            spot = (*backs[side], side * np.pi / 2)
            if self.try_place(piece, *spot, front):
                return spot
        return None

    def somewhere(self, kind: str, rng: np.random.Generator) -> None:
        """Put a piece of furniture at a random place, squarely, with room to use it from its front."""
        piece = MAKERS[kind](rng)
        x_low, y_low, x_high, y_high = self.room
        front = FRONT_M + 0.1 if piece.has_front else 0.0
        for _ in range(TRIES):
            place = float(rng.uniform(x_low, x_high)), float(rng.uniform(y_low, y_high))
            if self.try_place(piece, *place, int(rng.integers(4)) * np.pi / 2, front):
                return

    def table_with_chairs(self, rng: np.random.Generator) -> None:
        """A table somewhere in the room with chairs on its long sides, each with room to sit down."""
        table = MAKERS["table"](rng)
        x_low, y_low, x_high, y_high = self.room
        for _ in range(TRIES):
            heading = int(rng.integers(2)) * np.pi / 2
            x = rng.uniform(x_low + 1.3, max(x_high - 1.3, x_low + 1.3))
            y = rng.uniform(y_low + 1.3, max(y_high - 1.3, y_low + 1.3))
            if self.try_place(table, x, y, heading):
                break
        else:
            return
        for side in (-1, 1):
            for across in (-0.32, 0.32):
                chair = MAKERS["chair"](rng)
                off = side * (table.size[0] / 2 + rng.uniform(0.30, 0.42))
                cx, cy = _ahead(*_ahead(x, y, heading, off), heading + np.pi / 2, across * table.size[1] / 0.8 * 0.6)
                turned = heading + (0.0 if side < 0 else np.pi) + rng.uniform(-0.4, 0.4)
                if rng.uniform() < 0.75:
                    self.try_place(chair, cx, cy, turned)

    def furnish(self, kind: str, rng: np.random.Generator) -> None:
        """Fill a room of a kind (`ROOM_KINDS`)."""
        narrow = min(self.room[2] - self.room[0], self.room[3] - self.room[1])
        if kind in HAS_TABLE and rng.uniform() < 0.8 and narrow > 2.9:
            self.table_with_chairs(rng)
        for name in ROOM_KINDS[kind]:
            if rng.uniform() < 0.15:
                continue
            spot = self.against_wall(MAKERS[name](rng), rng)
            if spot and name == "desk":
                chair, place = MAKERS["chair"](rng), _ahead(*spot, rng.uniform(0.65, 0.8))
                self.try_place(chair, *place, spot[2] + np.pi + rng.uniform(-0.5, 0.5))
            if spot and name == "sofa" and rng.uniform() < 0.5:
                # A patterned rug in front of the sofa is visible, but no obstacle.
                x, y = _ahead(*spot, 1.2)
                size = (float(rng.uniform(1.2, 1.6)), float(rng.uniform(1.6, 2.2)))
                if _inside(_outline(size, x, y, spot[2]), self.room):
                    self.builder.add_box((x, y, self.z + 0.004), (*size, 0.008), (0.6, 0.3, 0.3), 40.0, spot[2])


def _ahead(x: float, y: float, heading: float, distance: float) -> tuple[float, float]:
    return x + distance * np.cos(heading), y + distance * np.sin(heading)


def _outline(size: tuple[float, float], x: float, y: float, heading: float) -> Box:
    cos, sin = abs(np.cos(heading)), abs(np.sin(heading))
    half_x, half_y = (cos * size[0] + sin * size[1]) / 2, (sin * size[0] + cos * size[1]) / 2
    return (x - half_x, y - half_y, x + half_x, y + half_y)


def _inside(inner: Box, outer: Box) -> bool:
    return bool(inner[0] >= outer[0] and inner[1] >= outer[1] and inner[2] <= outer[2] and inner[3] <= outer[3])
