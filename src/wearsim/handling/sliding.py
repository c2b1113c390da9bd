"""Pushing and pulling sofas, tables and chairs over the floor, with one hand, both, or one after the other."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from wearsim.handling.grips import Grip, GripPlace, Handling
from wearsim.people.gait import glide
from wearsim.people.plan import LEFT_SIGN, OTHER, SIDES, Plan, wrap
from wearsim.people.posture import look_at, turn_head
from wearsim.people.track import ease
from wearsim.people.walking import arrive, shuffle
from wearsim.places.movables import Movable, Rail, floor_pose
from wearsim.places.outline import turn

SPEEDS = {"sofa": (0.12, 0.26), "table": (0.13, 0.32), "chair": (0.18, 0.42)}
"""Range of an object's mean speed (m/s); the peak is about 1.5 times that."""
EFFORT = {"sofa": 1.0, "table": 0.6, "chair": 0.2}
"""Relative weight of an object, for the body's lean."""
TURN_LEVER_M = 0.7
"""Path length that takes as long as a turn of one radian (m)."""
TURN_FREE = np.deg2rad(4.0)
"""Turn from which on an object needs both hands."""
PUSH, PULL = np.deg2rad(62.0), np.deg2rad(118.0)
"""Directions within the first angle of the holder's heading are pushes, beyond the second pulls, else sideways."""


@dataclass(frozen=True)
class Slide:
    """A plan to slide an object, not yet written to the motion's plan."""

    movable: Movable
    start: Float[np.ndarray, "3"]
    """Pose of the object before: x, y (m), heading (rad)."""
    stop: Float[np.ndarray, "3"]
    """Pose of the object after, its heading unwrapped."""
    bow: float
    """Sideways deviation of its path from the straight line (m)."""
    places: dict[str, GripPlace]
    """Palm places by hand."""
    hands: tuple[tuple[str, ...], ...]
    """Sets of holding hands, one after the other."""
    local: Float[np.ndarray, "3"]
    """Pose of the body in the object's axes: x, y, heading."""
    seconds: float
    pause_s: float
    """Pause in the middle of the path, hands on; 0 for none."""
    travel_angle: float
    """Direction of travel relative to the body's heading, -π … π."""

    def object_at(self, share: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time 3"]:
        """Pose of the object (x, y, heading) at a share of the path."""
        change = self.stop - self.start
        across = np.array([-change[1], change[0], 0.0])
        across /= max(float(np.linalg.norm(across)), 1e-9)
        return self.start + share[:, None] * change + self.bow * (np.sin(np.pi * share) ** 2)[:, None] * across

    def body_at(self, share: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time 3"]:
        """Pose of the wearer (x, y, heading) at a share of the path."""
        x, y, heading = self.object_at(share).T
        (cos, sin), (ahead, left, turned) = (np.cos(heading), np.sin(heading)), self.local
        return np.stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left, heading + turned], 1)

    @property
    def stand(self) -> Float[np.ndarray, "3"]:
        """Initial pose of the wearer: x, y, heading."""
        return self.body_at(np.zeros(1))[0]

    def share(self, since: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time"]:
        """Share of the path after these times (s), with the pause."""
        if self.pause_s == 0.0:
            return glide(np.clip(since / self.seconds, 0.0, 1.0), (0.4, 0.4))
        half = self.seconds / 2
        first, second = since / half, (since - half - self.pause_s) / half
        return 0.5 * (ease(first) + ease(second))


def slide_options(
    plan: Plan, movable: Movable, start: Float[np.ndarray, "3"], stop: Float[np.ndarray, "3"], rng: np.random.Generator
) -> Iterator[Slide]:
    """Options for sliding an object from one place to another (x, y in m, heading in rad) for this wearer.

    They come in a random order that prefers pushing and pulling to moving sideways. The caller of an option checks that
    its `object_at` and `body_at` are free, goes to its `stand` and calls `slide`.
    """
    start = np.asarray(start, np.float64)
    stop = np.append(np.asarray(stop, np.float64)[:2], start[2] + wrap(stop[2] - start[2]))
    turns = bool(abs(stop[2] - start[2]) > TURN_FREE)
    if not turns:
        stop[2] = start[2]
    displacement = stop[:2] - start[:2]
    found = []
    for rail in movable.rails:
        angle = 0.0
        if np.hypot(*displacement) > 0.05:
            angle = wrap(float(np.arctan2(displacement[1], displacement[0])) - start[2] - rail.facing)
        aside = PUSH < abs(angle) < PULL
        for both in (True, False):
            if (both and not rail.both_hands) or (turns and not both) or (aside and movable.category == "sofa"):
                continue
            weight = 1.0 if both else {"chair": 1.5, "table": 0.5}.get(movable.category, 0.25)
            found.append((rng.exponential(1.0) / ((0.25 if aside else 1.0) * weight), rail, both, angle))
    for _, rail, both, angle in sorted(found, key=lambda option: option[0]):
        yield _drawn(plan, movable, np.stack([start, stop]), rail, both, angle, rng)


def _drawn(
    plan: Plan, movable: Movable, ends: np.ndarray, rail: Rail, both: bool, angle: float, rng: np.random.Generator
) -> Slide:
    """Draw the remaining choices: hands and their places, tempo, pause, distance."""
    start, stop = ends
    change = stop - start
    length, turned = float(np.linalg.norm(change[:2])), abs(change[2])
    speed = rng.uniform(*SPEEDS[movable.category]) * plan.style.briskness**0.5
    if PUSH < abs(angle) < PULL:
        speed *= 0.75
    seconds = max((length + TURN_LEVER_M * turned) / speed, 1.2)
    pause = rng.uniform(0.5, 1.6) if seconds > 3.0 and rng.random() < 0.25 else 0.0
    # sets of holding hands, one after the other; only both may turn an object
    hands: tuple[tuple[str, ...], ...] = (SIDES,)
    if turned == 0:
        first = SIDES[int(rng.random() < 0.6)]
        other = OTHER[first]
        if seconds < 3.5 or rng.random() > (0.3 if both else 0.25):
            hands = (SIDES,) if both else ((first,),)
        elif not both:
            hands = ((first,), (other,))
        else:
            hands = (((first,), SIDES), (SIDES, (first,)), ((first,), SIDES, (other,)))[rng.integers(3)]
    used = sorted({side for group in hands for side in group})
    wide = 2.0 * float(plan.skeleton.t_parent_joint[plan.skeleton.indices("left_collar", "left_shoulder"), 1].sum())
    apart = min(wide * rng.uniform(0.75, 1.5), rail.length) if len(used) > 1 else 0.0
    reach = max(rail.length - apart, 0.0) / 2
    middle = rail.length / 2 + float(np.clip(rng.normal(0.0, 0.4), -1, 1)) * min(reach, 0.5)
    if turned > 0.5:  # the lever is longer near an end
        middle = rail.length / 2 + float(rng.choice([-1.0, 1.0])) * reach * rng.uniform(0.0, 0.8)
    tilt, across = rng.uniform(0.0, 0.18), 0.85 * rng.beta(0.6, 1.2)
    places = {}
    for side in used:
        offset = -LEFT_SIGN[side] * apart / 2 + 0.03 * rng.standard_normal() * (rail.length > 0.1)
        along = float(np.clip(middle + offset, 0.0, rail.length))
        place = rail.at(along, tilt + rng.normal(0.0, 0.05), across + 0.15 * rng.uniform())
        places[side] = place.varied(rng, 0.12, 0.25)
    bow = float(np.clip(rng.normal(0.0, 0.05), -0.1, 0.1)) * length if turned == 0 else 0.0
    # the middle of the feet: toes clear of the object, hands in front of their shoulders
    ahead, left = turn(rail.facing).T
    heavy = (0.15 if abs(angle) < PUSH else 0.05) * EFFORT[movable.category]
    distance = plan.sole[1] + 0.05 + 0.55 * speed + heavy + rng.uniform(0.0, 0.07)
    aside = -LEFT_SIGN[used[0]] * rng.uniform(0.10, 0.24) if len(used) == 1 else 0.0
    faced = 0.06 * rng.standard_normal()
    if PUSH < abs(angle) < PULL:
        faced += 0.25 * np.sign(angle)
    point = np.mean([place.point for place in places.values()], 0)
    place = point[:2] - (rail.stand_off + distance) * ahead + aside * left
    local = np.append(place, rail.facing + faced)
    return Slide(movable, start, stop, bow, places, hands, local, seconds, pause, angle)


def slide(plan: Plan, choice: Slide, rng: np.random.Generator, floor_z: float = 0.0) -> Handling:
    """Take hold of an object, move it and let go; the wearer stands at or near `choice.stand`.

    Writes footsteps, lean, grips and gaze; `plan.time` becomes the end. The object is static at `choice.stop` then.
    """
    arrive(plan, rng, choice.stand)
    touch = plan.time + float(np.clip(rng.normal(0.8, 0.15) / plan.style.briskness, 0.5, 1.3))
    begin = touch + 0.2 + min(rng.exponential(0.5), 2.5)
    end = begin + (choice.seconds + choice.pause_s)
    moves = lambda times, chest: floor_pose(choice.object_at(choice.share(times - begin)), floor_z)  # noqa: E731
    release = end + 0.05 + min(rng.exponential(0.7), 3.0)
    # one grip per hand, from its first to its last set; sets change while the object moves
    count = len(choice.hands)
    cuts = begin + (end - begin) * (np.arange(1, count) + 0.25 * rng.uniform(-1, 1, count - 1)) / count
    grips = []
    for side in choice.places:
        member = [k for k, group in enumerate(choice.hands) if side in group]
        first, last = member[0], member[-1]
        # the new hand takes hold a little before the other lets go.
        start = touch + _stagger(rng) if first == 0 else cuts[first - 1] - rng.uniform(0.1, 0.4)
        stop = release + _stagger(rng) if last == count - 1 else cuts[last]
        grips.append((side, Grip.drawn(choice.places[side], moves, start, stop, rng, plan.style.briskness)))
    for side, grip in grips:
        plan.grip(side, grip)
    _lean(plan, choice, plan.time, begin, end, release, rng)
    # one looks at the place of the grip, then about where the path leads
    local = torch.tensor(next(iter(choice.places.values())).point, dtype=torch.float64)
    pose = floor_pose(choice.start, floor_z)
    point = (pose.R @ local + pose.t).numpy()
    look_at(plan, point, (touch - 0.6, touch - 0.2), (begin + 0.1, begin + 0.8), 0.85)
    time, back = begin + 0.6, abs(choice.travel_angle) > PULL
    while time < end - 0.8:
        over_shoulder = back and rng.random() < 0.4
        yaw = rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.1) if over_shoulder else rng.normal(0, 0.2)
        time = turn_head(plan, time, yaw, rng.normal(0.35, 0.12)) + rng.exponential(1.2) + 0.3
    turn_head(plan, max(time, end))
    base = float(choice.stand[2])
    unwrap = np.array([0.0, 0.0, plan.heading + wrap(base - plan.heading) - base])
    shuffle(plan, rng, lambda times: choice.body_at(choice.share(times - begin)) + unwrap, begin, end)
    plan.time = max(plan.time, release + 0.5 * max(grip.return_s for _, grip in grips))
    return Handling.of(choice.movable.name, "sliding", moves, grips)


def _stagger(rng: np.random.Generator) -> float:
    """Delay between hands (s): they come and go together, or one after the other."""
    return min(rng.exponential(0.25), 0.9) if rng.random() < 0.7 else 0.0


def _lean(
    plan: Plan, choice: Slide, start: float, begin: float, end: float, release: float, rng: np.random.Generator
) -> None:
    """Lean into a push, back in a pull; a little already when taking hold."""
    effort = EFFORT[choice.movable.category]
    pushes, pulls = abs(choice.travel_angle) < PUSH, abs(choice.travel_angle) > PULL
    ready = float(np.clip(rng.normal(0.22, 0.06), 0.08, 0.4))
    lean, shift, crouch = ready, 0.0, 0.0
    if pushes:
        lean = float(np.clip(rng.normal(0.22 + 0.34 * effort, 0.08), 0.12, 0.75))
        shift, crouch = 0.15 * effort * rng.uniform(0.6, 1.2), 0.06 * effort * rng.uniform(0.0, 1.0)
    elif pulls:
        lean = float(np.clip(rng.normal(0.20 - 0.05 * effort, 0.08), 0.0, 0.4))
        shift, crouch = -0.10 * effort * rng.uniform(0.5, 1.2), 0.07 * effort * rng.uniform(0.3, 1.2)
    twist = 0.0
    if len(choice.places) == 1:
        twist = -LEFT_SIGN[next(iter(choice.places))] * rng.uniform(0.02, 0.18)
    plan.lean.move(start, begin - 0.1, (ready, 0.0, 0.5 * twist))
    plan.lean.move(begin - 0.2, begin + 0.7, (lean, 0.0, twist))
    plan.crouch.move(begin - 0.2, begin + 0.7, crouch)
    plan.shift.move(begin - 0.2, begin + 0.6, (shift, 0.0))
    plan.shift.move(end - 0.6, end + 0.1, (0.0, 0.0))
    plan.crouch.move(end - 0.3, release + 0.4, 0.0)
    plan.lean.move(end - 0.3, release + 0.7, (0.0, 0.0, 0.0))
