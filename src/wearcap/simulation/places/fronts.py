"""Cabinets and wardrobes with drawers and doors that open: the carcass belongs to the world, its fronts are objects."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from wearcap.simulation.places.builder import Part, Piece
from wearcap.simulation.places.furniture import wood
from wearcap.simulation.places.openables import Openable, drawer, hinged

Place = Callable[[tuple[float, float]], Float[np.ndarray, "3"]]
"""Maps a point in the piece's frame to a floor point in the world (m)."""
LOW_M, HIGH_M = 0.38, 1.1
"""Height range of the middles of fronts that can be opened; others stay shut."""
GAP_M = 0.006
MOST_OPEN = np.deg2rad(100.0)


def cabinet(piece: Piece, place: Place, heading: float, rng: np.random.Generator) -> tuple[Piece, list[Openable]]:
    """A cabinet with the piece's outline, 0.8–1.15 m high, in columns of drawers or a door each."""
    depth, width = piece.size
    height, foot = float(rng.uniform(0.8, 1.15)), 0.06
    columns = max(int(np.ceil(width / 0.8)), 1)
    wide = width / columns
    parts, openables = [_carcass(depth, width, height, foot, rng)], []
    for column in range(columns):
        middle = -width / 2 + (column + 0.5) * wide
        if rng.random() < 0.7:
            rows = int(rng.integers(3, 5))
            edges = np.linspace(foot + 0.02, height - 0.02, rows + 1)
            for low, high in pairwise(edges):
                if LOW_M < (low + high) / 2 < HIGH_M:
                    travel = float(rng.uniform(0.3, min(0.5, depth - 0.06)))
                    openables.append(
                        drawer(
                            place((depth / 2, middle)),
                            heading,
                            wide - GAP_M,
                            (float(low) + GAP_M, float(high)),
                            depth - 0.04,
                            travel,
                            rng,
                        )
                    )
                else:
                    parts.append(_shut(depth, middle, wide, (float(low), float(high))))
        else:
            openables.append(
                _door(
                    place,
                    heading,
                    depth,
                    (middle - wide / 2, middle + wide / 2),
                    (foot + 0.02, height - 0.02),
                    float(rng.choice([-1.0, 1.0])),
                    rng,
                )
            )
    return replace(piece, z_range=(0.0, height), parts=tuple(parts)), openables


def wardrobe(piece: Piece, place: Place, heading: float, rng: np.random.Generator) -> tuple[Piece, list[Openable]]:
    """A wardrobe: the piece with doors of 0.45–0.65 m."""
    depth, width = piece.size
    height, columns = piece.z_range[1], int(np.ceil(width / 0.65))
    wide = width / columns
    doors = [
        _door(
            place,
            heading,
            depth,
            (-width / 2 + k * wide, -width / 2 + (k + 1) * wide),
            (0.08, height - 0.03),
            -1.0 if k % 2 else 1.0,
            rng,
        )
        for k in range(columns)
    ]
    return replace(piece, parts=(_carcass(depth, width, height, 0.06, rng),)), doors


def _carcass(depth: float, width: float, height: float, foot: float, rng: np.random.Generator) -> Part:
    middle = (foot + height) / 2
    return Part((-0.0125, 0.0, middle), (depth - 0.025, width, height - foot), wood(rng), 3.0)


def _shut(depth: float, middle: float, wide: float, level: tuple[float, float]) -> Part:
    low, high = level
    return Part(
        (depth / 2 - 0.01, middle, (low + high) / 2), (0.02, wide - GAP_M, high - low - GAP_M), (0.5, 0.4, 0.3), 3.0
    )


def _door(
    place: Place,
    heading: float,
    depth: float,
    span: tuple[float, float],
    level: tuple[float, float],
    hand: float,
    rng: np.random.Generator,
) -> Openable:
    """A door hinged at the right (`hand` 1, seen from the front) or left end of its span."""
    low, high = span
    at_low = hand > 0
    foot = place((depth / 2, low + GAP_M / 2 if at_low else high - GAP_M / 2))
    along = heading + np.pi / 2 if at_low else heading - np.pi / 2
    return hinged("cabinet_door", foot, along, -1.0 if at_low else 1.0, high - low - GAP_M, level, MOST_OPEN, rng)


FRONTED = {"cabinet": cabinet, "wardrobe": wardrobe}
"""Makers of fronts by kind of piece."""
