"""Activities of a wearer. Each is a function that writes footsteps and channels onto the plan.

A new one (a door, a sofa to push, a box to carry) is a function `(plan, world, rng) -> bool` under `@activity`;
it returns False, without having written anything, where the world gives no occasion for it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wearcap.simulation.people.gaze import look_about
from wearcap.simulation.people.plan import Plan, wrap
from wearcap.simulation.people.walking import turn_to, walk_along
from wearcap.simulation.places.world import World

Act = Callable[[Plan, World, np.random.Generator], bool]


@dataclass(frozen=True)
class Activity:
    """An activity; `weight` is its share among all draws, `outdoors` the factor on that weight outdoors."""

    act: Act
    weight: float
    outdoors: float = 1.0


RUN_RISE_M = 0.02
"""Largest rise (m) between waypoints 0.1 m apart when running: a ramp is allowed, a step is not."""
FREE_M = 0.45
ELSEWHERE = 0.4
"""Share of walks outdoors that go up or down if they can: the terrace is small beside the street."""

ACTIVITIES: dict[str, Activity] = {}


def activity(name: str, weight: float, outdoors: float = 1.0) -> Callable[[Act], Act]:
    """Enter a function into `ACTIVITIES`."""

    def enter(act: Act) -> Act:
        ACTIVITIES[name] = Activity(act, weight, outdoors)
        return act

    return enter


def start_place(world: World, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """A free floor point (m), off the stairs, and a heading (rad) to start from."""
    return _free_point(world, rng), float(rng.uniform(-np.pi, np.pi))


def _free_point(world: World, rng: np.random.Generator, beside_z: float | None = None) -> np.ndarray:
    """A random free place to stand; outdoors, often one that is higher or lower than `beside_z` (m)."""
    points = world.sample_floor(rng, 24)
    free = (world.clearance(points) > FREE_M) & ~on_stairs(world, points)
    if world.outdoors and beside_z is not None and rng.random() < ELSEWHERE:
        other = free & (np.abs(points[:, 2] - beside_z) > 0.3)
        free = other if other.any() else free
    return points[np.flatnonzero(free)[0]] if free.any() else points[0]


def on_stairs(world: World, points: np.ndarray) -> np.ndarray:
    """Whether floor points lie on a flight or within a step of its ends."""
    near = np.zeros(len(points), bool)
    for flight in world.flights:
        run, side = flight.up_and_left(points[:, :2])
        near |= (run > -0.8) & (run < flight.length + 0.8) & (np.abs(side) < flight.width / 2 + 0.1)
    return near


@activity("stand", weight=2.0)
def stand(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Stand for some seconds, looking about a little."""
    stop = plan.time + rng.uniform(1.5, 6.0)
    look_about(plan, plan.time, stop, rng, spread=0.35)
    plan.time = stop
    return True


@activity("look_around", weight=1.0)
def look_around(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Stand and look far about, the trunk turning with the head."""
    start, stop = plan.time, plan.time + rng.uniform(4.0, 9.0)
    look_about(plan, start, stop, rng, spread=0.75, pause_s=1.2)
    time = start + 0.4
    while time < stop - 2.0:
        plan.lean.move(time, time + 0.9, (0.0, 0.0, np.clip(rng.normal(0.0, 0.22), -0.5, 0.5)))
        time += rng.uniform(1.2, 3.0)
    plan.lean.move(stop - 0.9, stop, 0.0)
    plan.time = stop
    return True


@activity("turn", weight=1.0)
def turn(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Turn on the spot."""
    turn_to(plan, plan.heading + rng.choice([-1, 1]) * rng.uniform(0.7, 3.1), rng)
    plan.time += rng.uniform(0.4, 1.2)
    return True


@activity("walk", weight=6.0)
def walk(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Walk to another place, over stairs where the path leads there."""
    return approach(plan, world, rng, None)


@activity("run", weight=1.0, outdoors=3.0)
def run(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Run along a path of at least 5 m without a step; False where none is found."""
    path = _path_to_run(plan, world, rng)
    if path is None:
        return False
    start = plan.time
    walk_along(plan, path, rng, float(rng.uniform(2.2, 3.2)), ())
    look_about(plan, start + 1.0, plan.time, rng, spread=0.12, pause_s=2.2)
    plan.time += rng.uniform(0.25, 0.6)
    return True


def _path_to_run(plan: Plan, world: World, rng: np.random.Generator, tries: int = 4) -> np.ndarray | None:
    for _ in range(tries):
        goal = _free_point(world, rng)
        if np.linalg.norm(goal[:2] - plan.position[:2]) < 3.0:
            continue
        path = world.plan_path(plan.position, goal, rng)
        if path is not None and path_length(path) > 5.0 and np.abs(np.diff(path[:, 2])).max() < RUN_RISE_M:
            return path
    return None


def approach(
    plan: Plan, world: World, rng: np.random.Generator, goal: np.ndarray | None, heading: float | None = None
) -> bool:
    """Walk to a floor point (m; a free one when None) and turn there to a heading (rad); False without a path."""
    goal = _free_point(world, rng, float(plan.position[2])) if goal is None else goal
    path = world.plan_path(plan.position, goal, rng)
    if path is None or (heading is None and path_length(path) < 1.2):
        return False
    follow(plan, world, rng, path, heading)
    return True


def follow(plan: Plan, world: World, rng: np.random.Generator, path: np.ndarray, heading: float | None = None) -> None:
    """Walk along a path that `World.plan_path` found and turn to a heading (rad) at its end."""
    start = plan.time
    if path_length(path) > 0.25:
        speed = plan.style.speed * float(np.exp(rng.normal(0.0, 0.13)))
        walk_along(plan, path, rng, speed, world.flights)
        look_about(plan, start + 1.0, plan.time, rng, spread=0.22, pause_s=3.0)
    if heading is not None and abs(wrap(heading - plan.heading)) > 0.2:
        turn_to(plan, heading, rng)
    plan.time += rng.uniform(0.25, 0.6)


def path_length(path: np.ndarray) -> float:
    """Horizontal length of a path over the floor (m)."""
    return float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())
