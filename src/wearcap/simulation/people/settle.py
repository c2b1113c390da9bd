"""Sitting down and getting up: on the world's seats, crouching and picking objects up."""

import numpy as np

from wearcap.simulation.people.actions import activity, approach
from wearcap.simulation.people.gaze import look_about
from wearcap.simulation.people.hands import ON_THIGHS, hold
from wearcap.simulation.people.plan import SIDES, Plan
from wearcap.simulation.places.world import World

HIP_OVER_SEAT_M = 0.10
"""Height of a sitter's hip joints above the seat."""


@activity("sit", weight=2.0)
def sit(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Walk to a seat, turn round, sit for a while, get up."""
    if not world.seats:
        return False
    seat = world.seats[rng.integers(len(world.seats))]
    if not approach(plan, world, rng, seat.standing_point(), seat.heading):
        return False
    down, up = rng.uniform(1.5, 2.2, 2) / plan.style.briskness
    start = plan.time + rng.uniform(0.1, 0.4)
    leave = start + down + rng.uniform(4.0, 14.0)
    hips = np.array([*seat.position[:2], seat.position[2] + HIP_OVER_SEAT_M])
    plan.seat.move(start - 0.01, start - 0.01, hips)
    _down_and_up(plan, start, down, leave, up, rng)
    if rng.random() < 0.75:
        hold(plan, SIDES, ON_THIGHS, start + 0.5 * down, leave + 0.4 * up, rng)
    look_about(plan, start + down, leave, rng, spread=0.4)
    plan.time = leave + up + rng.uniform(0.1, 0.5)
    return True


def _down_and_up(plan: Plan, start: float, down: float, leave: float, up: float, rng: np.random.Generator) -> None:
    """Lean forward 40–45°, hips back and down, lean back; and in reverse order (Schenkman et al. 1990)."""
    bow, seated_lean = np.deg2rad(rng.uniform(36, 44)), rng.normal(-0.06, 0.06)
    plan.lean.move(start, start + 0.55 * down, (bow, 0.0, 0.0))
    plan.seat_weight.move(start, start + 0.85 * down, (1.0, 0.0))
    plan.seat_weight.move(start + 0.15 * down, start + down, (1.0, 1.0))
    plan.lean.move(start + 0.60 * down, start + 1.35 * down, (seated_lean, 0.0, 0.0))
    plan.lean.move(leave - 0.35 * up, leave + 0.25 * up, (bow, 0.0, 0.0))
    plan.seat_weight.move(leave, leave + 0.85 * up, (1.0, 0.0))
    plan.seat_weight.move(leave + 0.1 * up, leave + 0.95 * up, (0.0, 0.0))
    plan.lean.move(leave + 0.40 * up, leave + up, 0.0)


@activity("crouch", weight=1.2)
def crouch(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Bend knees and trunk, often to touch the floor, and come up again."""
    start = plan.time + 0.1
    depth = rng.uniform(0.18, 0.44) * plan.hip_height
    down = (0.6 + 1.1 * depth) * rng.uniform(0.9, 1.3) / plan.style.briskness
    leave = start + down + rng.uniform(0.4, 3.5)
    up = down * rng.uniform(1.0, 1.25)
    lean = rng.uniform(0.35, 0.6) + 0.5 * depth
    plan.crouch.move(start, start + down, depth)
    plan.crouch.move(leave, leave + up, 0.0)
    plan.lean.move(start, start + down, (lean, 0.0, rng.normal(0.0, 0.08)))
    plan.lean.move(leave, leave + up, 0.0)
    if depth > 0.3 * plan.hip_height:
        for side in SIDES:
            plan.heel_lift[side].move(start + 0.3 * down, start + down, 0.35)
            plan.heel_lift[side].move(leave, leave + 0.6 * up, 0.0)
    if rng.random() < 0.7:
        _touch_floor(plan, start, down, leave, up, rng)
    plan.time = leave + up + rng.uniform(0.1, 0.5)
    return True


def _touch_floor(plan: Plan, start: float, down: float, leave: float, up: float, rng: np.random.Generator) -> None:
    """Touch an object that lies in front of the feet with one hand."""
    side = str(rng.choice(SIDES))
    angle = plan.heading + rng.normal(0.0, 0.3) + (0.25 if side == "left" else -0.25)
    reach = rng.uniform(0.32, 0.5)
    point = plan.position + np.array([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(0.12, 0.45)])
    hand = plan.hands[side]
    hand.goal.move(start, start, point)
    hand.goal_weight.move(start, start + down, 1.0)
    hand.goal_weight.move(leave, leave + up, 0.0)
    plan.gaze_point.move(start, start, point)
    plan.gaze_weight.move(start, start + 0.5, 1.0)
    plan.gaze_weight.move(leave, leave + 0.6, 0.0)
