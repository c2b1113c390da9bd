"""Puts furniture into a rectangle of floor so that it overlaps nothing, blocks no door and is usable from its front."""

from dataclasses import dataclass, field

import numpy as np

from wearcap.simulation.places.builder import Piece, WorldBuilder
from wearcap.simulation.places.furniture import MAKERS
from wearcap.simulation.places.outline import Box, overlaps

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

HAS_TABLE = ("living room", "kitchen")


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
