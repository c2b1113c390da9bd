"""Walking paths over the floor: grid paths made smooth, kept off obstacles, straight on stairs."""

import numpy as np
from jaxtyping import Float

from wearcap.simulation.places.navigation import CLEARANCE_M, NavigationGrid

WAYPOINT_M = 0.1
SMOOTHING_PASSES = 80
STAIR_APPROACH_M = 0.5
"""Distance from stairs within which paths are straight."""


def plan_path(
    grid: NavigationGrid,
    flights: tuple,
    start: Float[np.ndarray, "3"],
    goal: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "waypoint 3"] | None:
    """A smooth path from start to goal, waypoints about 0.1 m apart; heights only to a cell. None without a path."""
    cells = grid.shortest(start, goal, shyness=rng.uniform(1.0, 4.0))
    if cells is None:
        return None
    points = _evenly(np.concatenate([start[None], cells, goal[None]]))
    if len(points) < 4:
        return points
    layer = grid.layer_of(points)
    sides = [rng.uniform(-1, 1) * max(flight.width / 2 - 0.35, 0.0) for flight in flights]
    for _ in range(SMOOTHING_PASSES):
        moved = points.copy()
        moved[1:-1, :2] += 0.5 * ((points[:-2, :2] + points[2:, :2]) / 2 - points[1:-1, :2])
        for flight, side in zip(flights, sides):
            _onto_line(moved, flight, side)
        clear = grid._clearance_in(layer, moved[:, :2])
        tight = (clear < CLEARANCE_M) & (clear < grid._clearance_in(layer, points[:, :2]))
        points = np.where(tight[:, None], points, moved)
    return _evenly(points)


def _onto_line(points: np.ndarray, flight, side: float) -> None:
    """Move, in place, the inner points on a flight to `side` metres left of its middle line."""
    run, off = flight.up_and_left(points[:, :2])
    on = (run > -STAIR_APPROACH_M) & (run < flight.length + STAIR_APPROACH_M) & (np.abs(off) < flight.width / 2)
    on &= (points[:, 2] > flight.base_z - 0.3) & (points[:, 2] < flight.top_z + 0.3)
    on[[0, -1]] = False
    points[on, :2] += ((side - off[on]) * 0.5)[:, None] * flight.left


def _evenly(points: np.ndarray) -> np.ndarray:
    """The same polyline with waypoints spaced evenly in the plane, both ends kept."""
    length = np.concatenate([[0.0], np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).cumsum()])
    count = max(int(np.ceil(length[-1] / WAYPOINT_M)), 1) + 1
    place = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(place, length, axis) for axis in points.T], 1)
