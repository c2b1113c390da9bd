"""Uses of held objects: drinking, hammering, drilling, mopping, lifting, swinging, hugging, tossing about.

Each use is done where the wearer stands, and ends with the object in its carrying pose.
"""

from collections.abc import Callable

import numpy as np

from wearsim.handling.holding import HeldObject
from wearsim.people.plan import Plan
from wearsim.people.posture import look_about, turn_head

Use = Callable[[Plan, HeldObject, np.random.Generator], None]
USES: dict[str, list[Use]] = {}
"""Uses by what is held, or by that and "in both hands"; one that stands there twice is twice as frequent."""

MOUTH_M = (0.10, 0.0, 0.0)
"""Position of the mouth from the head's joint."""
TILT = (1.15, 1.45)
"""Tilt range of a bottle while drinking (rad)."""


def use(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Do a random use that fits the held object and the number of hands; `plan.time` becomes its end."""
    choice = held.choice
    kind = choice.movable.category
    if kind == "tool":
        kind = "mop" if choice.long else "hammer" if choice.lies else "drill"
    elif choice.side is None:
        kind += " in both hands"
    uses = USES[kind]
    uses[rng.integers(len(uses))](plan, held, rng)


def _use_of(*kinds: str) -> Callable[[Use], Use]:
    """Enter a function into `USES`."""

    def enter(act: Use) -> Use:
        for kind in kinds:
            USES.setdefault(kind, []).append(act)
        return act

    return enter


@_use_of("bottle", "bottle", "bottle")
def _drink(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Bring a bottle to the mouth and tilt it, once or twice."""
    choice, head = held.choice, plan.bones("neck", "head").sum(0).numpy() + np.array(MOUTH_M)
    mouth = (head - plan.shoulder) / held.reach
    top = choice.movable.height - choice.middle[2]
    aside = float(np.abs(choice.middle[:2]).max())
    time = plan.time + 0.1
    for _ in range(rng.integers(1, 3)):
        tilt, yaw = rng.uniform(*TILT), -rng.uniform(0.1, 0.4)
        ahead, up = top * np.sin(tilt), -top * np.cos(tilt)
        off = np.array([ahead * np.cos(yaw) - aside * np.sin(yaw), ahead * np.sin(yaw) + aside * np.cos(yaw), up])
        at = mouth + off / held.reach
        raise_ = rng.uniform(0.9, 1.3) / plan.style.briskness
        before = (float(at[0] + 0.06), float(at[1] + 0.02), float(at[2] - 0.14))
        held.go(time, time + raise_, before, -0.35 * tilt, 0.5 * yaw)
        tip = time + raise_ - 0.25
        held.go(tip, tip + 0.8, tuple(at.tolist()), -tilt, yaw)
        turn_head(plan, tip, 0.0, -0.22)
        sip = tip + 0.8 + rng.uniform(0.6, 2.2)
        held.go(sip, sip + 0.7, before, -0.3 * tilt, 0.5 * yaw)
        turn_head(plan, sip)
        time = sip + 0.6
        if rng.random() < 0.6:
            held.return_to_carry(time, time + 0.9)
            time += 0.9 + rng.uniform(0.1, 0.8)
    held.return_to_carry(time, time + 0.9)
    plan.time = time + 0.95


@_use_of("hammer")
def _hammer(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Strike in front of the body, each stroke raised slower than it falls."""
    level, out = rng.uniform(-0.60, -0.25), rng.uniform(-0.12, 0.06)
    low = (rng.uniform(0.62, 0.74), out, level)
    high = (low[0] - 0.16, out + 0.06, level + rng.uniform(0.16, 0.30))
    start = plan.time + 0.1
    plan.lean.move(start, start + 0.8, (rng.uniform(0.08, 0.22), 0.0, 0.0))
    held.go(start, start + 0.9, low, 0.35)
    time = start + 0.9 + rng.uniform(0.1, 0.6)
    for _ in range(rng.integers(4, 9)):
        cock = rng.uniform(0.34, 0.5)
        held.go(time, time + cock, high, -rng.uniform(0.55, 0.8))
        fall = rng.uniform(0.24, 0.34)
        held.go(time + cock, time + cock + fall, low, 0.35)
        time += cock + fall + rng.uniform(0.02, 0.12)
        if rng.random() < 0.12:
            time += rng.uniform(0.5, 1.5)
    _watch(plan, held, low, start, time)
    plan.lean.move(time, time + 0.8, 0.0)
    held.return_to_carry(time + 0.1, time + 1.0)
    plan.time = time + 1.05


@_use_of("drill")
def _drill(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Press a drill forwards at one or two places."""
    start = time = plan.time + 0.1
    at = (0.0, 0.0, 0.0)
    for _ in range(rng.integers(1, 3)):
        at = (rng.uniform(0.58, 0.70), rng.uniform(-0.25, 0.05), rng.uniform(-0.45, 0.10))
        pitch = rng.normal(0.0, 0.08)
        held.go(time, time + 1.0, at, pitch)
        press = time + 1.0 + rng.uniform(0.1, 0.4)
        stop = press + rng.uniform(1.2, 3.5)
        held.go(press, stop, (at[0] + 0.10, at[1], at[2]), pitch)
        plan.lean.move(press, stop, (rng.uniform(0.06, 0.16), 0.0, 0.0))
        held.go(stop, stop + 0.5, at, pitch)
        plan.lean.move(stop, stop + 0.6, 0.0)
        time = stop + 0.5 + rng.uniform(0.1, 0.4)
    _watch(plan, held, at, start, time)
    held.return_to_carry(time, time + 1.0)
    plan.time = time + 1.05


@_use_of("mop")
def _mop(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Sweep the floor before the feet from side to side."""
    choice = held.choice
    lean, low = rng.uniform(0.15, 0.3), rng.uniform(0.62, 0.70)
    length = float(choice.middle[0]) + choice.movable.half_size[0]
    high = plan.shoulder_height - low * held.reach - 0.10 * lean
    tilt = -float(np.arccos(np.clip((high - 0.03) / length, 0.3, 0.95)))
    start = plan.time + 0.1
    plan.lean.move(start, start + 1.0, (lean, 0.0, 0.0))
    time, sign = start + 1.0, float(rng.choice([-1.0, 1.0]))
    held.go(start, time, (0.42, -0.05, -low), tilt)
    for _ in range(rng.integers(4, 8)):
        beat, wide = rng.uniform(0.65, 1.1), rng.uniform(0.6, 1.0)
        held.go(time, time + beat, (0.42, -0.05 + 0.12 * sign * wide, -low), tilt, 0.45 * sign * wide)
        plan.lean.move(time, time + beat, (lean, 0.0, 0.12 * sign * wide * choice.sign))
        time, sign = time + beat, -sign
    _watch(plan, held, (1.2, 0.0, -2.0), start, time)
    plan.lean.move(time, time + 1.0, 0.0)
    held.return_to_carry(time, time + 1.1)
    plan.time = time + 1.15


@_use_of("suitcase", "suitcase", "backpack")
def _hold_up(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Lift the object that hangs from the hand up in front of the body, as if onto a shelf, and lower it again."""
    x, y, z = (held.carry[:3] / held.reach).tolist()
    start, up = plan.time + 0.1, rng.uniform(1.0, 1.5) / plan.style.briskness
    height = rng.uniform(0.15, 0.32)
    at = (x + rng.uniform(0.30, 0.45), y - rng.uniform(0.0, 0.15), z + height)
    held.go(start, start + up, at, -rng.uniform(0.0, 0.12))
    plan.lean.move(start, start + up, (-0.08, 0.10 * held.choice.sign, 0.0))
    stop = start + up + rng.uniform(0.6, 2.5)
    _watch(plan, held, (0.6, y, z), start, stop)
    plan.lean.move(stop, stop + up, (0.0, 0.05 * held.choice.sign, 0.0))
    held.return_to_carry(stop, stop + up)
    plan.time = stop + up + 0.1


@_use_of("suitcase", "backpack")
def _swing_about(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Let the object that hangs from the hand swing forwards and back."""
    x, y, z = (held.carry[:3] / held.reach).tolist()
    time, size, sign = plan.time + 0.1, rng.uniform(0.12, 0.25), 1.0
    for number in range(rng.integers(4, 9)):
        beat = rng.uniform(0.65, 0.8)
        far = size * sign * (0.6 if number == 0 or sign < 0 else 1.0)
        held.go(time, time + beat, (x + far, y, z + 0.4 * far**2), -1.1 * far)
        time, sign = time + beat, -sign
    held.return_to_carry(time, time + 0.8)
    look_about(plan, plan.time, time, rng, spread=0.25)
    plan.time = time + 0.85


@_use_of("bottle")
def _inspect(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Hold a small object up in front of the eyes and turn it about."""
    start, time = plan.time + 0.1, plan.time + 1.0
    at = (rng.uniform(0.5, 0.6), rng.uniform(-0.2, -0.05), rng.uniform(-0.30, -0.12))
    held.go(start, time, at, -0.1, -0.1)
    for _ in range(rng.integers(2, 5)):
        beat = rng.uniform(0.6, 1.1)
        held.go(time, time + beat, at, rng.normal(-0.05, 0.2), rng.normal(-0.1, 0.25), rng.normal(0.0, 0.2))
        time += beat + rng.uniform(0.2, 0.8)
    _watch(plan, held, at, start, time)
    held.return_to_carry(time, time + 0.9)
    plan.time = time + 0.95


@_use_of("backpack in both hands", "backpack in both hands")
def _hug(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Draw an object between both hands to the chest, and hold it there."""
    start, near = plan.time + 0.1, 0.13 + held.choice.extent[0]
    stop = start + 0.9 + rng.uniform(1.5, 4.0)
    at = (near / held.reach, 0.0, -rng.uniform(0.38, 0.50))
    held.go(start, start + 0.9, at, -0.08)
    time, sign = start + 1.0, 1.0
    while time < stop - 1.4 and rng.random() < 0.8:
        held.go(time, time + 0.7, at, -0.08, 0.1 * sign)
        plan.lean.move(time, time + 0.7, (0.0, 0.0, 0.14 * sign))
        time, sign = time + 0.7, -sign
    plan.lean.move(stop - 0.5, stop + 0.3, 0.0)
    held.return_to_carry(stop, stop + 0.8)
    look_about(plan, start, stop, rng, spread=0.3)
    plan.time = stop + 0.85


@_use_of("ball in both hands")
def _overhead(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Raise an object between both hands in front of and above the head, up to three times."""
    start = time = plan.time + 0.1
    for _ in range(rng.integers(1, 4)):
        up = rng.uniform(0.8, 1.1) / plan.style.briskness
        turned = -rng.uniform(0.6, 0.9)
        top = (rng.uniform(0.45, 0.55), rng.normal(0.0, 0.03), rng.uniform(0.40, 0.56))
        held.go(time, time + up, (0.68, 0.0, 0.0), 0.4 * turned)
        held.go(time + 0.6 * up, time + 1.6 * up, top, turned)
        plan.lean.move(time + 0.6 * up, time + 1.6 * up, (-0.06, 0.0, 0.0))
        stop = time + 1.6 * up + rng.uniform(0.3, 1.6)
        held.go(stop, stop + up, (0.68, 0.0, 0.0), 0.4 * turned)
        held.return_to_carry(stop + 0.6 * up, stop + 1.6 * up)
        plan.lean.move(stop, stop + up, 0.0)
        time = stop + 1.6 * up + rng.uniform(0.1, 0.5)
    if rng.random() < 0.5:
        turn_head(plan, start + 0.8, 0.0, -0.25)
        turn_head(plan, time - 1.2)
    plan.time = time


@_use_of("backpack in both hands", "ball in both hands")
def _sway(plan: Plan, held: HeldObject, rng: np.random.Generator) -> None:
    """Move an object between both hands from side to side, the trunk turning with it."""
    start = time = plan.time + 0.1
    ahead, level, sign = (rng.uniform(0.58, 0.68), rng.uniform(-0.50, -0.25), float(rng.choice([-1.0, 1.0])))
    for _ in range(rng.integers(3, 8)):
        beat, far = rng.uniform(0.7, 1.2), rng.uniform(0.2, 0.42) * sign
        held.go(time, time + beat, (ahead - 0.25 * abs(far), far, level + rng.normal(0.0, 0.03)), 0.0, 0.9 * far)
        plan.lean.move(time, time + beat, (0.0, 0.0, 0.55 * far))
        time, sign = time + beat + rng.uniform(0.0, 0.3), -sign
    _watch(plan, held, (1.2, 0.0, level), start, time)
    plan.lean.move(time, time + 0.9, 0.0)
    held.return_to_carry(time, time + 0.9)
    plan.time = time + 0.95


def _watch(plan: Plan, held: HeldObject, at: tuple[float, float, float], start_s: float, stop_s: float) -> None:
    """Look at the working hands: a place given as in `HeldObject.go`."""
    shoulder = plan.shoulder
    ahead, out, up = held.reach * np.array(at)
    aside = held.choice.sign * (out + (0.0 if held.choice.side is None else shoulder[1]))
    cos, sin = np.cos(plan.heading), np.sin(plan.heading)
    x, y, z = plan.position
    point = [x + ahead * cos - aside * sin, y + ahead * sin + aside * cos, max(z + plan.shoulder_height + up, z)]
    plan.gaze_point.move(start_s, start_s, point)
    plan.gaze_weight.move(start_s + 0.1, start_s + 0.7, 0.85)
    plan.gaze_weight.move(stop_s, stop_s + 0.6, 0.0)
