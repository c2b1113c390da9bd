"""Standing places while a hand follows a handle: a body path that keeps within reach and clear of obstacles.

Places on a grid have a cost at every key; the cheapest path through them is found by dynamic programming.
"""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from wearcap.simulation.places.outline import distance_to_convex

SPACING_M = 0.07
AROUND_M = 1.15
"""Distance from the handle's path within which places are considered."""
BODY_M, ARM_M = 0.25, 0.02
"""Half the width that a body needs, and an arm."""
EASY_M = 0.12
"""Additional clearance over `BODY_M` up to which the cost falls."""
STEP_M = 0.30
"""Largest step between two keys."""
HELP_M = 0.30
"""Distance beyond an arm's reach that the trunk can cover."""
ASIDE = 0.35
"""Preferred bearing of a hand to its own side of the body's heading (rad)."""
SHOULDER_ASIDE_M = 0.18


@dataclass(frozen=True)
class Task:
    """Path of a handle and of the object that moves with it; keys are evenly spaced in time."""

    handle: Float[np.ndarray, "key 3"]
    """Position of the palm (m)."""
    footprint: Float[np.ndarray, "key 4 2"]
    """Outline of the moved object."""
    solid: tuple[Float[np.ndarray, "corner 2"], ...]
    """Outlines of obstacles for the body."""
    high: tuple[Float[np.ndarray, "corner 2"], ...]
    """Outlines of the obstacles that an arm cannot pass over."""
    sign: float
    """1 for the left hand, -1 for the right."""
    shoulder_m: float
    """Height of the shoulders (m)."""
    reach_m: float
    """Distance from shoulder to palm."""
    low: bool = False
    """Whether the moved object is so low that an arm passes over it."""
    beyond: tuple[Float[np.ndarray, "2"], float] | None = None
    """A point, and the preferred distance from it (m): who pulls a leaf does not step behind it."""


@dataclass(frozen=True)
class Stances:
    """Floor points between the feet and headings (m, m, rad unwrapped) at the task's keys, and their total cost."""

    places: Float[np.ndarray, "key 3"]
    cost: float


def find_stances(task: Task, walkable: Float[np.ndarray, "point 2"], rng: np.random.Generator) -> Stances | None:
    """The cheapest path, or None where none is free; it begins within 0.45 m of a walkable point."""
    low, high = task.handle[:, :2].min(0) - AROUND_M, task.handle[:, :2].max(0) + AROUND_M
    axes = [np.arange(a, b, SPACING_M) for a, b in zip(low, high)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    points += rng.uniform(-0.5, 0.5, 2) * SPACING_M
    near = np.linalg.norm(points[:, None] - task.handle[None, :, :2], axis=-1).min(1) < AROUND_M
    points = points[near]
    room = np.min([distance_to_convex(points, outline) for outline in task.solid], 0)
    points, room = points[room >= BODY_M], room[room >= BODY_M]
    if not len(points) or not len(walkable):
        return None
    cost, heading = _rated(task, points, room)
    cost += 0.15 * rng.standard_normal(len(points))
    away = np.linalg.norm(points[:, None] - walkable[None], axis=-1).min(1)
    cost[0, away > 0.45] = np.inf
    chosen, total = _cheapest(points, cost)
    if chosen is None:
        return None
    keys = np.arange(len(chosen))
    return Stances(np.column_stack([points[chosen], np.unwrap(heading[keys, chosen])]), total)


def _rated(
    task: Task, points: Float[np.ndarray, "point 2"], room: Float[np.ndarray, "point"]
) -> tuple[Float[np.ndarray, "key point"], Float[np.ndarray, "key point"]]:
    """Cost of standing at each point at each key, infinite where it is impossible, and the heading there."""
    offset = task.handle[:, None, :2] - points
    toward = np.arctan2(offset[..., 1], offset[..., 0])
    heading = toward - task.sign * ASIDE
    across = np.stack([-np.sin(heading), np.cos(heading)], -1)
    shoulder = points + task.sign * SHOULDER_ASIDE_M * across
    arm = task.handle[:, None, :2] - shoulder
    far = np.linalg.norm(arm, axis=-1)
    drop = np.minimum(np.abs(task.shoulder_m - task.handle[:, 2]), 0.8 * task.reach_m)[:, None]
    best = np.clip(np.sqrt((0.88 * task.reach_m) ** 2 - drop**2), 0.30, 0.55)
    cost = ((far - best) / 0.14) ** 2
    cost = np.where(far > best + HELP_M, np.inf, cost)
    if task.beyond is not None:
        pivot, radius = task.beyond
        cost += 4.0 * np.maximum(radius - np.linalg.norm(points - pivot, axis=1), 0.0) / 0.15
    leaf = np.stack([distance_to_convex(points, outline) for outline in task.footprint])
    free = np.minimum(leaf, room)
    cost += 2.0 * np.maximum(BODY_M + EASY_M - free, 0.0) / EASY_M
    cost[leaf < BODY_M] = np.inf
    cost[_arm_hits(task, shoulder, arm, far)] = np.inf
    return cost, heading


def _arm_hits(
    task: Task,
    shoulder: Float[np.ndarray, "key point 2"],
    arm: Float[np.ndarray, "key point 2"],
    far: Float[np.ndarray, "key point"],
) -> Bool[np.ndarray, "key point"]:
    """Whether the straight arm, except its last 7 cm, passes through the moved object or another."""
    last = np.clip(1.0 - 0.07 / np.maximum(far, 0.1), 0.0, 1.0)[..., None]
    hits = np.zeros(far.shape, bool)
    for share in np.linspace(0.25, 1.0, 7):
        along = shoulder + share * last * arm
        for key, outline in enumerate(task.footprint if not task.low else ()):
            hits[key] |= _within(along[key], outline, 0.01 if share == 1.0 else ARM_M)
        if share < 0.9:
            for outline in task.high:
                hits |= _within(along, outline, ARM_M)
    return hits


def _within(
    points: Float[np.ndarray, "*batch 2"], outline: Float[np.ndarray, "corner 2"], margin: float
) -> Bool[np.ndarray, "*batch"]:
    """Whether points lie in a convex counter-clockwise outline whose sides are moved outwards by a margin (m)."""
    inside = np.ones(points.shape[:-1], bool)
    x, y = points[..., 0], points[..., 1]
    for start, end in zip(outline, np.roll(outline, -1, axis=0)):
        edge = end - start
        inside &= edge[0] * (y - start[1]) - edge[1] * (x - start[0]) > -margin * np.hypot(*edge)
    return inside


def _cheapest(
    points: Float[np.ndarray, "point 2"], cost: Float[np.ndarray, "key point"]
) -> tuple[np.ndarray | None, float]:
    """Points by key with the least sum of their costs and of squared distances between them."""
    usable = np.isfinite(cost).any(0)
    points, cost, number = points[usable], cost[:, usable], np.flatnonzero(usable)
    if not len(points):
        return None, np.inf
    step = np.linalg.norm(points[:, None] - points[None], axis=-1)
    change = np.where(step > STEP_M, np.inf, (step / 0.11) ** 2)
    total, came = cost[0], []
    for key in range(1, len(cost)):
        through = total[:, None] + change
        best = through.argmin(0)
        came.append(best)
        total = through[best, np.arange(len(points))] + cost[key]
    if not np.isfinite(total).any():
        return None, np.inf
    path = [int(total.argmin())]
    for best in reversed(came):
        path.append(int(best[path[-1]]))
    return number[path[::-1]], float(total.min())


def smooth_path(places: Float[np.ndarray, "key 3"], count: int) -> Float[np.ndarray, "time 3"]:
    """The path at `count` even times, smooth, its ends kept."""
    at = np.linspace(0.0, len(places) - 1.0, count)
    fine = np.stack([np.interp(at, np.arange(len(places)), column) for column in places.T], 1)
    sigma = 0.9 * count / len(places)
    reach = max(int(3 * sigma), 1)
    padded = np.concatenate([np.repeat(fine[:1], reach, 0), fine, np.repeat(fine[-1:], reach, 0)])
    return scipy.ndimage.gaussian_filter1d(padded, sigma, axis=0)[reach : reach + count]
