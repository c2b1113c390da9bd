"""Activities of a wearer. Each is a function that writes footsteps and channels onto the plan.

A new one (a door, a sofa to push, a box to carry) is a function `(plan, world, rng) -> bool` under `@_activity`;
it returns False, without having written anything, where the world gives no occasion for it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wearsim.people.plan import LEFT_SIGN, SIDES, Plan, wrap
from wearsim.people.posture import look_about, look_at, turn_head
from wearsim.people.walking import turn_to, walk_along
from wearsim.places.outline import turn
from wearsim.places.world import World

Act = Callable[[Plan, World, np.random.Generator], bool]
Pose = tuple[float, ...]
"""A hand's pose channel (`HandScore.pose`)."""


@dataclass(frozen=True)
class _Activity:
    """An activity; `weight` is its share among all draws, `outdoors` the factor on that weight outdoors."""

    act: Act
    weight: float
    outdoors: float = 1.0


RUN_RISE_M = 0.02
"""Largest rise (m) between waypoints 0.1 m apart when running: a ramp is allowed, a step is not."""
FREE_M = 0.45
ELSEWHERE = 0.4
"""Share of walks outdoors that go up or down if they can: the terrace is small beside the street."""
POSTURES: dict[str, tuple[tuple[str, ...], Pose]] = {
    "clasped": (SIDES, (0.40, -0.24, -0.66, 0.35, 0.4, 0.1)),
    "on_hips": (SIDES, (0.06, 0.16, -0.74, 1.25, -0.4, 0.5)),
    "phone": (("right",), (0.48, -0.18, -0.28, 0.15, -0.7, 0.1)),
    "cup": (("left",), (0.50, -0.08, -0.34, 0.2, -0.5, 0.0)),
    "at_head": (("right",), (0.24, 0.02, 0.30, 0.9, -0.3, 0.3)),
    "tray": (SIDES, (0.62, -0.10, -0.42, 0.3, -1.1, 0.0)),
}
"""Hands, and their pose, by name."""
ON_THIGHS = (0.46, -0.02, -0.66, 0.35, 0.5, 0.1)
FINGERS_USED = 0.9
"""Share of the finger's length at which a hand touches its goal."""
HIP_OVER_SEAT_M = 0.10
"""Height of a sitter's hip joints above the seat."""
DEEP = 0.30
"""Crouches deeper than this share of the hip height lift the heels, by `HEELS_RAD`."""
HEELS_RAD = 0.35

ACTIVITIES: dict[str, _Activity] = {}


def _activity(name: str, weight: float, outdoors: float = 1.0) -> Callable[[Act], Act]:
    """Enter a function into `ACTIVITIES`."""

    def enter(act: Act) -> Act:
        ACTIVITIES[name] = _Activity(act, weight, outdoors)
        return act

    return enter


def start_place(world: World, rng: np.random.Generator) -> tuple[Float[np.ndarray, "3"], float]:
    """A free floor point (m), off the stairs, and a heading (rad) to start from."""
    return _free_point(world, rng), rng.uniform(-np.pi, np.pi)


def _free_point(world: World, rng: np.random.Generator, beside_z: float | None = None) -> Float[np.ndarray, "3"]:
    """A random free place to stand; outdoors, often one that is higher or lower than `beside_z` (m)."""
    points = world.sample_floor(rng, 24)
    free = (world.navigation.clearance_at(points) > FREE_M) & ~world.on_stairs(points)
    if world.outdoors and beside_z is not None and rng.random() < ELSEWHERE:
        other = free & (np.abs(points[:, 2] - beside_z) > 0.3)
        free = other if other.any() else free
    return points[np.flatnonzero(free)[0]] if free.any() else points[0]


def path_length(path: Float[np.ndarray, "waypoint 3"]) -> float:
    """Horizontal length of a path over the floor (m)."""
    return float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())


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
        speed = plan.style.gait.speed * float(np.exp(rng.normal(0.0, 0.13)))
        walk_along(plan, path, rng, speed, world.places.flights)
        look_about(plan, start + 1.0, plan.time, rng, spread=0.22, pause_s=3.0)
    if heading is not None and abs(wrap(heading - plan.heading)) > 0.2:
        turn_to(plan, heading, rng)
    plan.time += rng.uniform(0.25, 0.6)


def hold(
    plan: Plan, sides: tuple[str, ...], pose: Pose, start_s: float, stop_s: float, rng: np.random.Generator
) -> None:
    """Bring hands into a posture at one time and let them hang again at the other (s)."""
    rise = 0.7 / plan.style.briskness
    for side in sides:
        hand = plan.hands[side]
        varied = np.array(pose) + 0.04 * rng.standard_normal(6)
        # a hand that hangs may take its next posture unseen: only the weight moves it
        hangs = hand.pose_weight.last[0] < 0.01
        hand.pose.move(start_s, start_s if hangs else start_s + rise, varied)
        hand.pose_weight.visit(1.0, (start_s, start_s + rise * rng.uniform(0.9, 1.3)), (stop_s - rise, stop_s))


def squat(
    plan: Plan,
    rng: np.random.Generator,
    depths: tuple[float, float],
    leans: tuple[float, float],
    quickest_s: float,
    longest_s: float,
) -> tuple[float, float, float, float]:
    """Bend knees and trunk, stay for up to `longest_s`, and straighten them.

    `depths` is a range of shares of the hip height, `leans` one of forward leans (rad) of a flat squat, which would
    take about `quickest_s`. Returns the starts and durations of both ways (s).
    """
    start = plan.time + 0.1
    depth = rng.uniform(*depths) * plan.hip_height
    down = (quickest_s + 1.1 * depth) * rng.uniform(0.9, 1.3) / plan.style.briskness
    leave = start + down + rng.uniform(0.4, longest_s)
    up = down * rng.uniform(1.0, 1.25)
    lean = rng.uniform(*leans) + 0.5 * depth
    out, back = (start, start + down), (leave, leave + up)
    plan.crouch.visit(depth, out, back)
    plan.lean.visit((lean, 0.0, rng.normal(0.0, 0.08)), out, back)
    if depth > DEEP * plan.hip_height:
        for side in SIDES:
            plan.heel_lift[side].visit(HEELS_RAD, (start + 0.3 * down, out[1]), (leave, leave + 0.6 * up))
    return start, down, leave, up


@_activity("stand", weight=2.0)
def _stand(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Stand for some seconds, looking about a little."""
    stop = plan.time + rng.uniform(1.5, 6.0)
    look_about(plan, plan.time, stop, rng, spread=0.35)
    plan.time = stop
    return True


@_activity("look_around", weight=1.0)
def _look_around(plan: Plan, world: World, rng: np.random.Generator) -> bool:
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


@_activity("turn", weight=1.0)
def _turn(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Turn on the spot."""
    turn_to(plan, plan.heading + rng.choice([-1, 1]) * rng.uniform(0.7, 3.1), rng)
    plan.time += rng.uniform(0.4, 1.2)
    return True


@_activity("walk", weight=6.0)
def _walk(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Walk to another place, over stairs where the path leads there."""
    return approach(plan, world, rng, None)


@_activity("run", weight=1.0, outdoors=3.0)
def _run(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Run along a path of at least 5 m without a step; False where none is found."""
    for _ in range(4):
        goal = _free_point(world, rng)
        if np.linalg.norm(goal[:2] - plan.position[:2]) < 3.0:
            continue
        path = world.plan_path(plan.position, goal, rng)
        if path is not None and path_length(path) > 5.0 and np.abs(np.diff(path[:, 2])).max() < RUN_RISE_M:
            break
    else:
        return False
    start = plan.time
    walk_along(plan, path, rng, rng.uniform(2.2, 3.2))
    look_about(plan, start + 1.0, plan.time, rng, spread=0.12, pause_s=2.2)
    plan.time += rng.uniform(0.25, 0.6)
    return True


@_activity("hold", weight=1.2)
def _hold_posture(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Stand with hands on hips, clasped, at the phone …"""
    start, stop = plan.time, plan.time + rng.uniform(4.0, 10.0)
    name = rng.choice(list(POSTURES))
    hold(plan, *POSTURES[name], start + 0.2, stop, rng)
    if name in ("phone", "cup"):
        turn_head(plan, start + 0.5, rng.normal(-0.1, 0.08), 0.55)
        turn_head(plan, stop - 0.8)
    else:
        look_about(plan, start, stop, rng, spread=0.3)
    plan.time = stop
    return True


@_activity("gesture", weight=1.2)
def _gesture(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Talk with the hands: from posture to posture before the chest."""
    start, stop = plan.time, plan.time + rng.uniform(4.0, 9.0)
    for side in SIDES if rng.random() < 0.6 else (rng.choice(SIDES),):
        hand, time = plan.hands[side], start + rng.uniform(0.1, 0.6)
        first = True
        while time < stop - 1.2:
            pose = [*rng.normal((0.50, -0.02, -0.36), (0.13, 0.16, 0.16)), 0.4, rng.normal(-0.2, 0.4), 0.1]
            beat = rng.uniform(0.35, 0.8)
            hand.pose.move(time, time if first else time + beat, pose)
            if first:
                hand.pose_weight.move(time, time + 0.7, 1.0)
                beat = 0.7
            first, time = False, time + beat + rng.exponential(0.4)
        hand.pose_weight.move(stop - 0.9, stop, 0.0)
    look_about(plan, start, stop, rng, spread=0.2)
    plan.time = stop
    return True


@_activity("carry", weight=1.5)
def _carry_along(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Walk to another place with an object in the hands."""
    start = plan.time
    if not approach(plan, world, rng, None):
        return False
    if plan.time - start >= 3.0:
        hold(plan, *POSTURES[rng.choice(["phone", "cup", "tray", "clasped"])], start + 0.1, plan.time - 0.1, rng)
    return True


@_activity("reach", weight=2.5)
def _reach(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Go to a shelf, table or handle and take hold of a point there, crouching or leaning as it needs."""
    targets = world.places.reach_targets
    if not targets:
        return False
    target = targets[rng.integers(len(targets))]
    if not approach(plan, world, rng, np.array(target.stand), target.heading):
        return False
    for _ in range(rng.integers(1, 4)):
        # one reach with the nearer hand: minimum-jerk out, a pause, and back (0.4–1.2 s each way)
        ahead, across = turn(plan.heading).T
        off = np.append(0.08 * rng.standard_normal() * across, 0.04 * rng.standard_normal())
        touched = np.array(target.position) + off
        aside = float((touched[:2] - plan.position[:2]) @ across) + 0.1 * rng.standard_normal()
        side = "left" if aside > 0 else "right"
        arm, shoulder = plan.arm_length, 1.52 * plan.hip_height
        # the wrist's goal is where the fingers of a straight hand touch the point
        fingers = float(np.linalg.norm(plan.skeleton.sites["left_fingertip"].t_joint_site))
        arm_vector = touched - plan.position - np.append(LEFT_SIGN[side] * 0.17 * across, shoulder)
        point = touched - FINGERS_USED * fingers * arm_vector / np.linalg.norm(arm_vector)
        low = shoulder - (point[2] - plan.position[2])
        far = float((point[:2] - plan.position[:2]) @ ahead)
        crouch = float(np.clip(low - 1.05 * arm, 0.0, 0.42 * plan.hip_height))
        left_over = np.hypot(max(far, 0.0), max(low - crouch, -0.6)) - 0.90 * arm
        lean = float(np.clip(left_over / 0.45, 0.0, 0.9)) + 0.6 * crouch
        start = plan.time
        out = float(np.clip(0.45 + 0.55 * np.hypot(far, low) + 0.8 * crouch, 0.5, 1.6)) / plan.style.briskness
        hold_s, back = rng.uniform(0.3, 1.4), out * rng.uniform(1.0, 1.3)
        leave = start + out + hold_s
        there, home = (start, start + out), (leave, leave + back)
        inner = LEFT_SIGN[side] * np.clip(0.25 * lean, 0.0, 0.2)
        plan.lean.visit((lean, 0.0, -inner), there, home)
        plan.crouch.visit(crouch, there, home)
        plan.hands[side].go_for(point, there, home)
        look_at(plan, touched, (start, start + 0.45), (leave, leave + 0.5), 1.0)
        plan.time = leave + back + rng.uniform(0.05, 0.6)
    return True


@_activity("sit", weight=2.0)
def _sit(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Walk to a seat, turn round, sit for a while, get up.

    The trunk leans forward 40–45°, the hips go back and down, it leans back; in reverse order to get up (Schenkman et
    al. 1990).
    """
    seats = world.places.seats
    if not seats:
        return False
    seat = seats[rng.integers(len(seats))]
    if not approach(plan, world, rng, seat.standing_point(), seat.heading):
        return False
    down, up = rng.uniform(1.5, 2.2, 2) / plan.style.briskness
    start = plan.time + rng.uniform(0.1, 0.4)
    leave = start + down + rng.uniform(4.0, 14.0)
    plan.seat.move(start - 0.01, start - 0.01, (*seat.position[:2], seat.position[2] + HIP_OVER_SEAT_M))
    bow, seated_lean = np.deg2rad(rng.uniform(36, 44)), rng.normal(-0.06, 0.06)
    for first, last, lean in (
        (start, start + 0.55 * down, bow),
        (start + 0.60 * down, start + 1.35 * down, seated_lean),
        (leave - 0.35 * up, leave + 0.25 * up, bow),
        (leave + 0.40 * up, leave + up, 0.0),
    ):
        plan.lean.move(first, last, (lean, 0.0, 0.0))
    for first, last, weight in (
        (start, start + 0.85 * down, (1.0, 0.0)),
        (start + 0.15 * down, start + down, (1.0, 1.0)),
        (leave, leave + 0.85 * up, (1.0, 0.0)),
        (leave + 0.1 * up, leave + 0.95 * up, (0.0, 0.0)),
    ):
        plan.seat_weight.move(first, last, weight)
    if rng.random() < 0.75:
        hold(plan, SIDES, ON_THIGHS, start + 0.5 * down, leave + 0.4 * up, rng)
    look_about(plan, start + down, leave, rng, spread=0.4)
    plan.time = leave + up + rng.uniform(0.1, 0.5)
    return True


@_activity("crouch", weight=1.2)
def _crouch(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Bend knees and trunk, often to touch an object before the feet with one hand, and come up again."""
    start, down, leave, up = squat(plan, rng, (0.18, 0.44), (0.35, 0.6), 0.6, 3.5)
    if rng.random() < 0.7:
        side = str(rng.choice(SIDES))
        angle = plan.heading + rng.normal(0.0, 0.3) + (0.25 if side == "left" else -0.25)
        reach = rng.uniform(0.32, 0.5)
        point = plan.position + np.array([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(0.12, 0.45)])
        plan.hands[side].go_for(point, (start, start + down), (leave, leave + up))
        look_at(plan, point, (start, start + 0.5), (leave, leave + 0.6), 1.0)
    plan.time = leave + up + rng.uniform(0.1, 0.5)
    return True
