"""A simulated world's scan: what a laser scanner on a trolley measures from its stations, coloured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from wearcap.errors import WearcapError
from wearcap.scene.scan import Scan
from wearcap.simulation.places.world import World
from wearcap.simulation.rendering import scan_kernels
from wearcap.simulation.rendering.views import CUBE, Scenery, View, visible

CHUNK = 1_000_000
"""Number of surface samples that are measured at a time."""
CELL_M = 1.0
"""Side of the cells that share a list of near stations."""
TRIED = 40
"""Number of nearest stations that are checked for visibility of a point."""
PROBES = 6
"""Random points per face that decide whether it is seen at all."""


@dataclass(frozen=True)
class Scanner:
    """Settings of a scan."""

    station_m: float = 2.2
    """Distance between stations."""
    clearance_m: float = 0.45
    height_m: float = 1.75
    full_m: float = 4.0
    """Distance up to which surfaces have the full density; beyond it, density falls with the square of the distance."""
    max_m: float = 15.0
    noise_m: float = 0.003
    """Deviation of the range."""
    mixed: float = 0.25
    """Share of the points just behind an outline that float between it and what it hides."""
    wrong: float = 0.0004
    """Share of points with a range that is plainly wrong."""
    view_px: int = 224
    """Side of the six visibility images of a station."""


def scan_world(
    scenery: Scenery,
    spacing_m: float,
    rng: np.random.Generator,
    scanner: Scanner = Scanner(),
    walked: World | None = None,
) -> Scan:
    """The scan of a world: points about `spacing_m` apart on surfaces seen by any station, in the world's axes (m).

    Stations stand where one can walk in the world, or in `walked`: the same world without its doors.
    Raises WearcapError for a spacing that is not positive.
    """
    if not spacing_m > 0:
        raise WearcapError(f"points {spacing_m} m apart", expected="a positive spacing")
    stations = place_stations(walked or scenery.world, scanner.station_m, scanner.clearance_m)
    stations[:, 2] += scanner.height_m
    near = _near_stations(scenery.vertices, stations, scanner)
    survey = (stations, *near, _surroundings(scenery, stations, scanner.view_px))
    points, colors = [], []
    for face, place in _samples(scenery, spacing_m, _faces_seen(scenery, survey, scanner, rng), rng):
        measured, kept = _measured(scenery, survey, scanner, face, place, rng)
        points.append(measured[kept].astype(np.float32))
        footprint = np.full(int(kept.sum()), max(spacing_m, 0.01))
        colors.append(scenery.paint.colors_of(place[kept], face[kept], footprint))
    return Scan(np.concatenate(points), np.concatenate(colors))


def _measured(scenery: Scenery, survey: tuple, scanner: Scanner, face, place, rng) -> tuple:
    """Measured positions of surface samples, and a mask of those that were measured."""
    measured, kept = np.empty_like(place), np.zeros(len(place), bool)
    scan_kernels.measure(
        place,
        scenery.paint.frames[face, 9:12],
        *survey,
        rng.random((len(place), 3)),
        scanner.full_m,
        scanner.max_m,
        scanner.noise_m,
        scanner.mixed,
        scanner.wrong,
        rng.standard_normal(len(place)),
        measured,
        kept,
    )
    return measured, kept


def _faces_seen(
    scenery: Scenery, survey: tuple, scanner: Scanner, rng: np.random.Generator
) -> Bool[np.ndarray, "face"]:
    """Faces of which at least one of some random points is seen: most of a world's are inside or below others."""
    face = np.repeat(np.arange(len(scenery.faces)), PROBES)
    _, kept = _measured(scenery, survey, scanner, face, _on_faces(scenery, face, rng), rng)
    return kept.reshape(-1, PROBES).any(1)


def place_stations(world: World, spacing_m: float, clearance_m: float = 0.45) -> Float[np.ndarray, "station 3"]:
    """Floor points (m) that cover the walkable area, none nearer to another than the spacing; always the same."""
    points = world.navigation.node_points
    free = points[world.clearance(points) > clearance_m]
    points = free if len(free) else points
    left = np.ones(len(points), bool)
    chosen = []
    while left.any():
        chosen.append(int(left.argmax()))
        left &= np.linalg.norm(points - points[chosen[-1]], axis=1) >= spacing_m
    return points[chosen]


def _surroundings(
    scenery: Scenery, stations: Float[np.ndarray, "station 3"], size: int
) -> Float32[np.ndarray, "station 6 row column"]:
    """1/depth of each station's view through the sides of a cube along the world's axes."""
    out = np.empty((len(stations), 6, size, size), np.float32)
    half = (size - 1) / 2
    for number, station in enumerate(stations):
        for side, R in enumerate(CUBE):
            out[number, side] = visible(scenery, R, station, View(R, size / 2, half, half, size, size))[0]
    return out


def _near_stations(
    vertices: Float32[np.ndarray, "vertex 3"], stations: Float[np.ndarray, "station 3"], scanner: Scanner
) -> tuple[Int[np.ndarray, "entry"], Int[np.ndarray, "slot"], float, np.ndarray, np.ndarray]:
    """For every cell of the plan the nearest stations in reach, in order: entries, each cell's first, and the grid."""
    origin = vertices[:, :2].min(0).astype(np.float64) - 0.1
    shape = np.ceil((vertices[:, :2].max(0) + 0.1 - origin) / CELL_M).astype(np.int64)
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)
    middle = origin + (grid + 0.5) * CELL_M
    distance = np.linalg.norm(middle[:, None] - stations[None, :, :2], axis=-1)
    order = np.argsort(distance, axis=1)[:, :TRIED]
    within = np.take_along_axis(distance, order, 1) < scanner.max_m + CELL_M
    first = np.concatenate([[0], within.sum(1).cumsum()])
    return order[within], first, CELL_M, origin, shape


def _samples(scenery: Scenery, spacing_m: float, wanted: Bool[np.ndarray, "face"], rng: np.random.Generator):
    """(faces, points) of samples of the wanted faces as dense as the spacing asks, `CHUNK` or so at a time."""
    a, b, c = (scenery.vertices[scenery.faces[:, corner]].astype(np.float64) for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    ends = rng.poisson(wanted * area / spacing_m**2).cumsum()
    for start in range(0, int(ends[-1]), CHUNK):
        number = np.arange(start, min(start + CHUNK, int(ends[-1])))
        face = np.searchsorted(ends, number, side="right")
        yield face, _on_faces(scenery, face, rng)


def _on_faces(
    scenery: Scenery, face: Int[np.ndarray, "point"], rng: np.random.Generator
) -> Float[np.ndarray, "point 3"]:
    """A random point on each face."""
    a, b, c = (scenery.vertices[scenery.faces[face, corner]].astype(np.float64) for corner in range(3))
    u, v = rng.random((2, len(face), 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return a + u * (b - a) + v * (c - a)
