"""Hands: held postures and gestures while standing or walking, and reaching for objects."""

import numpy as np

from wearcap.simulation.people.actions import activity, approach
from wearcap.simulation.people.gaze import look_about, turn_head
from wearcap.simulation.people.plan import LEFT_SIGN, SIDES, Plan
from wearcap.simulation.places.world import ReachTarget, World

POSTURES: dict[str, tuple[tuple[str, ...], tuple[float, ...]]] = {
    "clasped": (SIDES, (0.40, -0.24, -0.66, 0.35, 0.4, 0.1)),
    "on_hips": (SIDES, (0.06, 0.16, -0.74, 1.25, -0.4, 0.5)),
    "phone": (("right",), (0.48, -0.18, -0.28, 0.15, -0.7, 0.1)),
    "cup": (("left",), (0.50, -0.08, -0.34, 0.2, -0.5, 0.0)),
    "at_head": (("right",), (0.24, 0.02, 0.30, 0.9, -0.3, 0.3)),
    "tray": (SIDES, (0.62, -0.10, -0.42, 0.3, -1.1, 0.0)),
}
"""Hands, and their pose channel (`HandScore.pose`), by name."""

FINGERS_USED = 0.9
"""Share of the finger's length at which a hand touches its goal."""
ON_THIGHS = (0.46, -0.02, -0.66, 0.35, 0.5, 0.1)


def hold(plan: Plan, sides: tuple[str, ...], pose: tuple[float, ...], start_s: float, stop_s: float, rng) -> None:
    """Bring hands into a posture at one time and let them hang again at the other (s)."""
    rise = 0.7 / plan.style.briskness
    for side in sides:
        hand = plan.hands[side]
        varied = np.array(pose) + 0.04 * rng.standard_normal(6)
        # A hand that hangs may take its next posture unseen: only the weight moves it.
        if hand.pose_weight.last[0] < 0.01:
            hand.pose.move(start_s, start_s, varied)
        else:
            hand.pose.move(start_s, start_s + rise, varied)
        hand.pose_weight.move(start_s, start_s + rise * rng.uniform(0.9, 1.3), 1.0)
        hand.pose_weight.move(stop_s - rise, stop_s, 0.0)


@activity("hold", weight=1.2)
def hold_posture(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Stand with hands on hips, clasped, at the phone …"""
    start, stop = plan.time, plan.time + rng.uniform(4.0, 10.0)
    name = rng.choice(list(POSTURES))
    sides, pose = POSTURES[name]
    hold(plan, sides, pose, start + 0.2, stop, rng)
    if name in ("phone", "cup"):
        turn_head(plan, start + 0.5, (rng.normal(-0.1, 0.08), 0.55))
        turn_head(plan, stop - 0.8, (0.0, plan.style.head_pitch))
    else:
        look_about(plan, start, stop, rng, spread=0.3)
    plan.time = stop
    return True


@activity("gesture", weight=1.2)
def gesture(plan: Plan, world: World, rng: np.random.Generator) -> bool:
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


@activity("carry", weight=1.5)
def carry(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Walk to another place with an object in the hands."""
    start = plan.time
    if not approach(plan, world, rng, None):
        return False
    if plan.time - start < 3.0:
        return True
    sides, pose = POSTURES[rng.choice(["phone", "cup", "tray", "clasped"])]
    hold(plan, sides, pose, start + 0.1, plan.time - 0.1, rng)
    return True


@activity("reach", weight=2.5)
def reach(plan: Plan, world: World, rng: np.random.Generator) -> bool:
    """Go to a shelf, table or handle and take hold of a point there, crouching or leaning as it needs."""
    if not world.reach_targets:
        return False
    target = world.reach_targets[rng.integers(len(world.reach_targets))]
    if not approach(plan, world, rng, np.array(target.stand), target.heading):
        return False
    for _ in range(rng.integers(1, 4)):
        _grasp(plan, target, rng)
    return True


def _grasp(plan: Plan, target: ReachTarget, rng: np.random.Generator) -> None:
    """One reach with the nearer hand: minimum-jerk out, a pause, and back (0.4–1.2 s each way)."""
    ahead = np.array([np.cos(plan.heading), np.sin(plan.heading)])
    across = np.array([-ahead[1], ahead[0]])
    point = np.array(target.position) + np.append(0.08 * rng.standard_normal() * across, 0.04 * rng.standard_normal())
    aside = float((point[:2] - plan.position[:2]) @ across) + 0.1 * rng.standard_normal()
    side = "left" if aside > 0 else "right"
    hand, arm = plan.hands[side], plan.arm_length
    shoulder = 1.52 * plan.hip_height
    touched, point = point, _wrist_before(plan, point, shoulder, LEFT_SIGN[side] * 0.17 * across)
    offset = point[:2] - plan.position[:2]
    low = shoulder - (point[2] - plan.position[2])
    far = float(offset @ ahead)
    crouch = float(np.clip(low - 1.05 * arm, 0.0, 0.42 * plan.hip_height))
    left_over = np.hypot(max(far, 0.0), max(low - crouch, -0.6)) - 0.90 * arm
    lean = float(np.clip(left_over / 0.45, 0.0, 0.9)) + 0.6 * crouch
    start = plan.time
    out = float(np.clip(0.45 + 0.55 * np.hypot(far, low) + 0.8 * crouch, 0.5, 1.6)) / plan.style.briskness
    hold_s, back = rng.uniform(0.3, 1.4), out * rng.uniform(1.0, 1.3)
    inner = LEFT_SIGN[side] * np.clip(0.25 * lean, 0.0, 0.2)
    plan.lean.move(start, start + out, (lean, 0.0, -inner))
    plan.crouch.move(start, start + out, crouch)
    hand.goal.move(start, start, point)
    hand.goal_weight.move(start, start + out, 1.0)
    plan.gaze_point.move(start, start, touched)
    plan.gaze_weight.move(start, start + 0.45, 1.0)
    leave = start + out + hold_s
    plan.lean.move(leave, leave + back, 0.0)
    plan.crouch.move(leave, leave + back, 0.0)
    hand.goal_weight.move(leave, leave + back, 0.0)
    plan.gaze_weight.move(leave, leave + 0.5, 0.0)
    plan.time = leave + back + rng.uniform(0.05, 0.6)


def _wrist_before(plan: Plan, point: np.ndarray, shoulder: float, aside: np.ndarray) -> np.ndarray:
    """Wrist position at which the fingers of a straight hand touch a point (m)."""
    fingers = float(np.linalg.norm(plan.skeleton.sites["left_fingertip"].t_joint_site))
    arm_vector = point - plan.position - np.append(aside, shoulder)
    return point - FINGERS_USED * fingers * arm_vector / np.linalg.norm(arm_vector)
