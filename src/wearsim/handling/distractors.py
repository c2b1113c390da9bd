"""Acts in front of an object that stays where it is: hands that rest on it, and what resembles handling but is not.

Each is done where the wearer stands. Only `rest_on` touches the object; hands that hover stop short of it.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import SceneObject
from wearsim.handling.grips import Grip, GripPlace, Handling, Vector, still, vector, wandering
from wearsim.handling.holding import bend_for, bow, keep_hands_aside
from wearsim.people.actions import ON_THIGHS, POSTURES, hold, squat
from wearsim.people.plan import SIDES, Plan
from wearsim.people.posture import look_about, look_at

Manner = Literal["move", "rest", "pretend"]
"""What is done with an object: it is moved; held without being moved; or neither moved nor touched."""
SHORT_M = (0.09, 0.14)
"""Range of the palm's distance from the surface of an object that is not touched."""
HOVER_M = 0.03
"""Deviation of the waves of such hands (m; `wandering`)."""
STAY_S, APART_S = (0.6, 3.0), 0.3
"""Range of the root of the time for which hands stay; mean delay of each hand in coming and in leaving."""
STANCES: dict[str, tuple[bool, tuple[float, ...]]] = {
    "in pockets": (True, (0.10, 0.04, -0.80, 0.8, 0.5, 0.1)),
    "hand in a pocket": (False, (0.10, 0.04, -0.80, 0.8, 0.5, 0.1)),
    "on hips": (True, POSTURES["on_hips"][1]),
    "on a railing": (True, (0.52, 0.02, -0.56, 0.45, 0.4, 0.3)),
    "leaning": (False, (0.74, 0.08, -0.14, 0.5, 0.0, 0.5)),
    "pointing": (False, (0.86, 0.00, -0.22, 0.3, 0.2, 0.0)),
}
"""Whether both hands take part, and the hands' pose (`HandScore.pose`), of who stands by and touches nothing."""
LOW_M, HOVER_LOW_M = 0.60, 0.18
"""Height of places below which one bends down, and the hands' distance then, beside the object."""


def pretend_to_handle(
    plan: Plan, places: dict[str, GripPlace], T_world_object: Rigid, height_m: float, rng: np.random.Generator
) -> None:
    """One of the acts that resemble handling, in front of an object of a height."""
    low = float(T_world_object.t[2]) + height_m < 0.95
    chance = rng.random()
    if low and chance < 0.10:
        bend_over(plan, T_world_object, height_m, rng)
    elif low and chance < 0.18:
        squat_by(plan, T_world_object, height_m, rng)
    elif chance < 0.26:
        gesture_at(plan, T_world_object, height_m, rng)
    elif chance < 0.42:
        stand_by(plan, T_world_object, height_m, rng)
    else:
        hover(plan, places, T_world_object, rng)


def hover(plan: Plan, places: dict[str, GripPlace], T_world_object: Rigid, rng: np.random.Generator) -> None:
    """Reach for places on an object as if to take hold, stop short of them, stay a while, and draw back."""
    short = {}
    for side, place in places.items():
        gap = rng.uniform(*SHORT_M) * np.array(place.normal) - rng.uniform(0.0, 0.03) * np.array(place.fingers)
        short[side] = replace(place, point=vector(np.array(place.point) + gap + 0.01 * rng.standard_normal(3)))
    _reach_out(plan, short, T_world_object, rng, free=True)


def rest_on(
    plan: Plan, touched: SceneObject, places: dict[str, GripPlace], T_world_object: Rigid, rng: np.random.Generator
) -> Handling:
    """Put hands on places of an object and leave them there for a while; it does not move."""
    grips = _reach_out(plan, places, T_world_object, rng, free=False)
    return Handling.of(touched.name, touched.freedom.contact_class, still(T_world_object), grips)


def _reach_out(
    plan: Plan, places: dict[str, GripPlace], T_world_object: Rigid, rng: np.random.Generator, free: bool
) -> list[tuple[str, Grip]]:
    """Reach for places, stay, and draw back; each hand comes and goes in its own time, and wanders where it is free.

    `places` is by hand, in the object's axes; they must be within reach of the standing wearer.
    """
    start, briskness = plan.time + 0.1, plan.style.briskness
    first = next(iter(places.values()))
    low = float((T_world_object.R.double() @ torch.tensor(first.point).double() + T_world_object.t)[2])
    crouch, lean = bend_for(plan, low - float(plan.position[2]), rng) if low < LOW_M else (0.0, 0.0)
    out = float(np.clip(rng.normal(0.8, 0.18) + crouch, 0.45, 1.6)) / briskness
    touch = start + out
    leave = touch + rng.uniform(*STAY_S) ** 2
    lean = lean or float(np.clip(rng.normal(0.2, 0.1), 0.0, 0.5))
    stop, grips = leave, []
    for side, place in places.items():
        late, later = rng.exponential(APART_S, 2)
        moves = wandering(still(T_world_object), rng, HOVER_M) if free else still(T_world_object)
        grip = Grip.drawn(place, moves, touch + late, max(leave, touch + late) + later, rng, briskness)
        if crouch > 0 or grip.start_s < plan.time:
            grip = replace(grip, reach_s=grip.touch_s - start)
        if crouch > 0:
            grip = replace(grip, return_s=1.1 * out, hover_m=HOVER_LOW_M)
        plan.grip(side, grip)
        grips.append((side, grip))
        stop = max(stop, grip.stop_s)
    if crouch > 0:
        keep_hands_aside(plan, (start, start + 0.45 * out), (leave, stop))
    bow(plan, start, touch, crouch, lean)
    bow(plan, leave, stop, 0.0, 0.0)
    _look(plan, T_world_object, first.point, start, min(leave, touch + rng.uniform(0.5, 2.0)))
    plan.time = stop
    return grips


def gesture_at(plan: Plan, T_world_object: Rigid, height: float, rng: np.random.Generator) -> None:
    """Gesture about an object of a height (m), looking at it now and then."""
    start, stop = plan.time, plan.time + rng.uniform(2.5, 6.0)
    for side in SIDES if rng.random() < 0.5 else (str(rng.choice(SIDES)),):
        hand, time, first = plan.hands[side], start + rng.uniform(0.1, 0.6), True
        while time < stop - 1.4:
            ahead, aside, up = rng.normal((0.62, -0.02, -0.42), (0.14, 0.16, 0.15))
            pose = [ahead, aside, up, 0.4, rng.normal(-0.2, 0.4), rng.normal(0.15, 0.15)]
            beat = 0.7 if first else rng.uniform(0.4, 0.9)
            hand.pose.move(time, time if first else time + beat, pose)
            if first:
                hand.pose_weight.move(time, time + beat, 1.0)
            first, time = False, time + beat + rng.exponential(0.5)
        if not first:
            hand.pose_weight.move(stop - 0.9, stop, 0.0)
    if rng.random() < 0.7:
        _look(plan, T_world_object, (0.0, 0.0, height), start + 0.2, stop - 0.8)
    plan.time = stop + 0.1


def stand_by(plan: Plan, T_world_object: Rigid, height: float, rng: np.random.Generator) -> None:
    """Stand at an object of a height (m) for a while in one of `STANCES`, looking at it first and then about."""
    start, stop = plan.time + 0.1, plan.time + rng.uniform(2.0, 6.0)
    both, pose = list(STANCES.values())[rng.integers(len(STANCES))]
    hold(plan, SIDES if both else (str(rng.choice(SIDES)),), pose, start, stop, rng)
    middle = start + rng.uniform(0.8, 1.6)
    _look(plan, T_world_object, (0.0, 0.0, height), start, middle)
    look_about(plan, middle + 0.6, stop, rng, spread=0.4)
    plan.time = stop


def bend_over(plan: Plan, T_world_object: Rigid, height: float, rng: np.random.Generator) -> None:
    """Lean over an object to look at it, hands hanging, on the back or on the thighs."""
    start = plan.time + 0.1
    down = rng.uniform(0.8, 1.3) / plan.style.briskness
    leave = start + down + rng.uniform(0.6, 3.0)
    lean = rng.uniform(0.35, 0.8)
    out, back = (start, start + down), (leave, leave + 1.1 * down)
    plan.lean.visit((lean, rng.normal(0.0, 0.08), rng.normal(0.0, 0.12)), out, back)
    plan.crouch.visit(rng.uniform(0.0, 0.08), out, back)
    if rng.random() < 0.5:
        hold(plan, SIDES, ON_THIGHS, start, leave + down, rng)
    _look(plan, T_world_object, (0.0, 0.0, 0.6 * height), start, leave)
    plan.time = leave + 1.1 * down + 0.1


def squat_by(plan: Plan, T_world_object: Rigid, height: float, rng: np.random.Generator) -> None:
    """Squat in front of a low object as if to lift it, hands on the thighs or before the knees, and get up again."""
    start, _, leave, up = squat(plan, rng, (0.24, 0.42), (0.3, 0.55), 0.7, 2.5)
    before = (0.42, rng.uniform(-0.05, 0.25), rng.uniform(-0.75, -0.55), 0.3, 0.2, 0.1)
    hold(plan, SIDES, ON_THIGHS if rng.random() < 0.5 else before, start, leave + 0.8 * up, rng)
    _look(plan, T_world_object, (0.0, 0.0, 0.6 * height), start, leave)
    plan.time = leave + up + 0.1


def _look(plan: Plan, T_world_object: Rigid, local: Vector, start: float, stop: float) -> None:
    """Look at a point in an object's axes (m) between two times (s)."""
    point = T_world_object.R.double().numpy() @ np.array(local) + T_world_object.t.double().numpy()
    look_at(plan, point, (start, start + 0.5), (stop, stop + 0.6), 0.85)
