"""Walking: footsteps along paths over the floor that meet the treads of stairs exactly, and small steps in place.

Small steps carry the body along any path: forwards, backwards, sideways, turning.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from wearsim.people.gait import FULL_STRIKE, advance, bump, climb
from wearsim.people.plan import LEFT_SIGN, OTHER, SIDES, STEP_M, Footprint, Plan, wrap
from wearsim.people.track import blur, ease
from wearsim.places.outline import turn
from wearsim.places.world import Flight

SPACING_M = 0.02
RUN_SPEED = 2.1
JOG_SPEED = 1.4
"""Speed (m/s) from which on a person who intends to run does so: at the start, the end and in curves."""
ACCELERATION, BRAKING = 1.0, 0.85
END_SPEED = 0.32
MIN_CADENCE = 80.0
LONGEST_STEP = 0.86
"""Longest step in walking, as a share of the hips' height; who is faster steps more often."""
READY_S = 0.42
"""Time between the decision to walk and the first foot's lift, in which the weight moves to the other leg."""
CURVE_SPEED = 0.95
"""Speed (m/s) in a curve of radius 1 m, for a wearer whose own speed is 1.3 m/s (two-thirds power law)."""
HEEL_ROOM_M, TOE_ROOM_M, EDGE_M = 0.055, 0.015, 0.08
"""Margins on treads: heel behind the ankle, toes before the next riser, and, going down, the ankle past the edge."""
PAST_KERB_M = 0.16
"""Distance of the ankle beyond a kerb's edge after stepping over it."""

Body = Callable[[Float[np.ndarray, "time"]], Float[np.ndarray, "time 3"]]
"""x, y (m) and unwrapped heading (rad) of the floor point between the feet at times (s)."""

GRID_S = 0.02
NEARBY_SPEED = 0.45
"""Speed of steps to a place nearby (m/s)."""
STILL = 0.035
"""Below this speed (m/s) no step is taken."""
TURNED_M = 0.24
"""Path length equivalent to a turn of one radian (m)."""
CLOSE_M = 0.15
"""Least lateral distance of the feet when one passes the other."""
APART_S = 0.05
"""Least time for which both feet stand between two steps."""


@dataclass(frozen=True)
class _Course:
    """A path to be walked, by arc length."""

    points: Float[np.ndarray, "point 3"]
    heading: Float[np.ndarray, "point"]
    speed: Float[np.ndarray, "point"]
    time: Float[np.ndarray, "point"]
    """Time since the start (s)."""
    phase: Float[np.ndarray, "point"]
    """Number of steps since the start; the foot of step k stands where phase is k."""
    on_stairs: Float[np.ndarray, "point"]
    """+1 going up, -1 going down, else 0."""
    run_from: float
    """Speed (m/s) from which on the gait is running."""

    @classmethod
    def of(cls, plan: Plan, path: Float[np.ndarray, "waypoint 3"], speed: float, flights: Sequence) -> "_Course":
        """Speed, time and step phase along a path. Steps fall on the treads of the flights that it takes."""
        # evenly spaced points of the path with rounded corners, and its unwrapped heading
        run = np.concatenate([[0.0], np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).cumsum()])
        count = max(int(run[-1] / SPACING_M), 4)
        even = np.stack([np.interp(np.linspace(0, run[-1], count), run, column) for column in path.T], 1)
        reach = min(40, count - 1)
        padded = np.concatenate([2 * even[0] - even[reach:0:-1], even, 2 * even[-1] - even[-2 : -reach - 2 : -1]])
        padded[:, :2] = blur(padded[:, :2], 0.16, 1 / SPACING_M)
        points = padded[reach : reach + count]
        points[:, 2] = even[:, 2]
        ahead = np.gradient(padded[:, :2], axis=0)[reach : reach + count]
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        length = np.arange(len(points)) * SPACING_M
        curvature = blur(np.abs(np.gradient(heading, SPACING_M)), 0.15, 1 / SPACING_M)
        pace = speed / 1.3 if speed < RUN_SPEED else 1.5
        limit = np.minimum(speed, CURVE_SPEED * pace * np.maximum(curvature, 0.05) ** (-1 / 3))
        anchors = [anchor for flight in flights for anchor in _tread_anchors(points, flight, plan.sole[1])]
        anchors = sorted(anchors, key=lambda anchor: anchor[0])
        stairs = np.zeros(len(points))
        for at, up, tread in anchors:
            near = np.abs(length - at) < 0.55 * tread
            stairs[near] = up
            beat = (0.58 if up > 0 else 0.54) / plan.style.briskness**0.5
            limit[near] = np.minimum(limit[near], tread / beat)
        # the highest speeds under the limit that start and stop gently: v² changes by no more than 2 a ds
        squared = limit**2
        squared = np.minimum(squared, END_SPEED**2 + 2 * ACCELERATION * length)
        squared = np.minimum(squared, END_SPEED**2 + 2 * BRAKING * length[::-1])
        rise, fall = 2 * ACCELERATION * length, 2 * BRAKING * length
        squared = np.minimum.accumulate(squared - rise) + rise
        limit = np.sqrt(np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall)
        limit = blur(limit, 0.10, 1 / SPACING_M)
        stride = np.minimum(np.sqrt(60 * plan.style.gait.walk_ratio * limit), limit * 60 / MIN_CADENCE)
        stride = np.minimum(stride, LONGEST_STEP * plan.hip_height)
        run_from = JOG_SPEED if speed > RUN_SPEED else np.inf
        stride = np.where(limit > run_from, limit * 60 / (158 + 6 * limit), stride)
        phase = np.concatenate([[0.0], np.cumsum(SPACING_M / stride[:-1])])
        time = np.concatenate([[0.0], np.cumsum(SPACING_M / limit[:-1])])
        # the phase is stretched piecewise, so that it is a whole number at every anchor and at the end
        knots, whole, previous = [0.0], [0], 0.0
        for end in [at for at, *_ in anchors if 0.1 < at < length[-1] - 0.1] + [length[-1]]:
            steps = np.interp(end, length, phase) - np.interp(previous, length, phase)
            knots.append(float(np.interp(end, length, phase)))
            whole.append(whole[-1] + max(round(steps), 1))
            previous = end
        return cls(points, heading, limit, time, np.interp(phase, knots, whole), stairs, run_from)

    def at_phase(self, name: str, phase: float) -> float:
        """Heading, speed, time or on_stairs at the phase; clamped at the ends."""
        return float(np.interp(phase, self.phase, getattr(self, name)))

    def footprint(self, plan: Plan, side: str, k: int, last: bool, speed: float, rng: np.random.Generator) -> Footprint:
        """Print of the k-th step, which varies about the path by the wearer's habit."""
        gait = plan.style.gait
        point = np.array([np.interp(k, self.phase, column) for column in self.points.T])
        heading, stairs = self.at_phase("heading", k), abs(self.at_phase("on_stairs", k)) > 0.5
        narrow = 0.6 if speed > self.run_from else 1.0
        width = gait.step_width * narrow * (1 + 3 * gait.variability * rng.standard_normal())
        if last:
            width = gait.stance_width * (1 + 0.1 * rng.standard_normal())
        length = gait.variability * rng.standard_normal() * 0.6 * (0.0 if stairs else 1.0)
        point[:2] += length * turn(heading)[:, 0]
        return plan.footprint(side, point, heading + 0.03 * rng.standard_normal(), width / 2)


def walk_along(
    plan: Plan, path: Float[np.ndarray, "waypoint 3"], rng: np.random.Generator, speed: float, flights: Sequence = ()
) -> None:
    """Turn towards a path's start, walk (or run, above 2.1 m/s) along it and stop at its end, feet together."""
    course = _Course.of(plan, path, speed, flights)
    ahead = float(np.interp(0.35, np.arange(len(course.heading)) * SPACING_M, course.heading))
    if abs(wrap(ahead - plan.heading)) > np.deg2rad(50):
        turn_to(plan, ahead - np.sign(wrap(ahead - plan.heading)) * np.deg2rad(15), rng)
    steps = round(course.phase[-1])
    # first the foot behind, else the inner one of a turn, else either
    turned = wrap(course.at_phase("heading", 1.0) - plan.heading)
    apart = (plan.prints["left"][-1].ground - plan.prints["right"][-1].ground)[:2]
    leads = apart @ turn(plan.heading)[:, 0]
    if abs(leads) > 0.1:
        side = "right" if leads > 0 else "left"
    elif abs(turned) > 0.2:
        side = "left" if turned > 0 else "right"
    else:
        side = SIDES[int(rng.random() < 0.5)]
    lands = np.array([course.at_phase("time", k - 0.5) for k in range(1, steps + 1)])
    tempo = np.diff(lands, append=lands[-1] + 0.55) if steps > 1 else np.array([0.6])
    lands = lands + plan.style.gait.variability * rng.standard_normal(steps) * np.clip(tempo, 0, 0.6) * 0.6
    lands = lands + plan.time + READY_S + 0.5 - lands[0]
    lands = np.append(lands, lands[-1] + max(tempo[-1], 0.55))
    for k, land in enumerate(lands, start=1):
        last = k > steps
        how = course.at_phase("speed", min(k, steps) - 0.5)
        print_ = course.footprint(plan, side, min(k, steps), last, how, rng)
        beat = land - lands[k - 2] if k > 1 else 0.62
        running = how > course.run_from and not last
        if running:  # there is a time in which neither foot stands
            both = float(np.clip(-0.22 - 0.08 * (how - RUN_SPEED), -0.38, -0.12))
        else:
            both = float(np.clip(0.21 + 0.12 * (1.3 - how), 0.14, 0.42))
        _walk_step(plan, side, land - beat * (1.0 - both) if k > 1 else land - 0.5, land, print_, running)
        side = OTHER[side]


def _walk_step(plan: Plan, side: str, lift: float, land: float, print_: Footprint, running: bool) -> None:
    """Add one step; the longer the stride, the more the foot rolls at its ends."""
    old = plan.prints[side][-1]
    lift = max(lift, old.land_s + 0.16)
    stride = float(np.linalg.norm((print_.ground - old.ground)[:2]))
    size = min(stride / 1.35, 1.15) * plan.style.gait.heel_rise
    rise = old.rise_to(print_)
    lift_pitch, land_pitch, clearance = (
        (0.85, -0.10, 0.10) if running else (1.04 * size**0.39, FULL_STRIKE * size, 0.012)
    )
    if rise > STEP_M:
        lift_pitch, land_pitch, clearance = 0.55, 0.06, 0.05
    elif rise < -STEP_M:
        lift_pitch, land_pitch, clearance = 0.60, 0.22, 0.03
    elif stride < 0.45:
        clearance = 0.03
    if rise >= -STEP_M:  # the foot is lifted to clear a step or crest whose corner it cuts
        share = np.linspace(0.15, 0.8, 14)
        moved = advance(share, np.array(rise))
        ankle = old.ground + moved[:, None] * (print_.ground - old.ground)
        heading = old.heading + share * wrap(print_.heading - old.heading)
        toes = ankle[:, :2] + plan.sole[1] * np.stack([np.cos(heading), np.sin(heading)], 1)
        floor = plan.floor_height(toes, np.full(len(share), max(old.ground[2], print_.ground[2])))
        line = old.ground[2] + (print_.ground[2] - old.ground[2] - rise) * moved + rise * climb(np.array(rise), share)
        need = np.nan_to_num(floor - line, nan=0.0)
        least = STEP_M if rise > STEP_M else 0.002
        need = np.where(need > least, (need + 0.02) / bump(share), 0.0)
        clearance = max(clearance, float(min(need.max(), 0.35)))
    swing = {"land_pitch": land_pitch, "clearance": clearance, "bow": LEFT_SIGN[side] * 0.012, "running": running}
    plan.step(side, lift, land, lift_pitch, replace(print_, **swing))


def _tread_anchors(points: np.ndarray, flight: Flight, foot: float) -> list[tuple[float, int, float]]:
    """(arc length, 1 up or -1 down, tread) of the places on a path where a foot must stand on a flight.

    `foot` is how far the toes are ahead of the ankle (m).
    """
    run, side = flight.up_and_left(points[:, :2])
    inside = (np.abs(side) < flight.width / 2 + 0.1) & (run > -0.6) & (run < flight.length + 0.6)
    climbed = flight.base_z + flight.rise * np.clip(run / flight.tread + 0.5, 0, flight.steps)
    inside &= np.abs(points[:, 2] - climbed) < 0.35  # the floors above and below the flight are not on it
    if inside.sum() < 3:
        return []
    first, last = np.flatnonzero(inside)[[0, -1]]
    up = 1 if run[last] > run[first] else -1
    treads = np.arange(flight.steps + 1) * flight.tread
    if flight.steps == 1:
        wanted = np.array([up * PAST_KERB_M])
    elif up > 0:
        wanted = np.concatenate([[-0.29], treads[:-1] + min(HEEL_ROOM_M, flight.tread - foot - TOE_ROOM_M)])
    else:
        wanted = np.concatenate([[treads[-2] + 0.20], treads[-2::-1] - EDGE_M])
    crossing = np.maximum.accumulate(run[first : last + 1] * up)
    crossing = crossing + 1e-9 * np.arange(len(crossing))
    wanted = wanted * up
    wanted = wanted[(wanted > crossing[0]) & (wanted < crossing[-1])]
    places = np.interp(wanted, crossing, np.arange(first, last + 1) * SPACING_M)
    return [(float(place), up, flight.tread) for place in places]


def turn_to(plan: Plan, heading: float, rng: np.random.Generator) -> None:
    """Turn on the spot to a heading (rad) in steps of at most about 55 degrees, the inner foot first."""
    start, center = plan.heading, plan.position
    turned = wrap(heading - start)
    side = "left" if turned > 0 else "right"
    count = max(int(np.ceil(abs(turned) / np.deg2rad(55))), 1) + 1
    beat = float(np.clip(0.56 * rng.normal(1.0, 0.07) / plan.style.briskness, 0.42, 0.8))
    land = plan.time + READY_S + 0.44 * beat / 0.56
    for k in range(1, count + 1):
        facing = start + turned * min(k / (count - 1 + 0.3), 1.0) if k < count - 1 else start + turned
        center[:2] += 0.012 * rng.standard_normal(2)
        width = plan.style.gait.stance_width * (1.0 + 0.08 * rng.standard_normal())
        how = {"land_pitch": -0.05, "clearance": 0.025, "bow": LEFT_SIGN[side] * 0.02}
        plan.step(side, land - 0.72 * beat, land, 0.22, plan.footprint(side, center, facing, width / 2, **how))
        side, land = OTHER[side], land + beat * rng.normal(1.0, 0.04)


@dataclass(frozen=True)
class _BodyPath:
    """Path of a body on a grid of times."""

    times: Float[np.ndarray, "time"]
    place: Float[np.ndarray, "time 3"]
    ahead: Float[np.ndarray, "time"]
    """Speed forwards, along the body's heading (m/s)."""
    aside: Float[np.ndarray, "time"]
    """Speed to the left (m/s)."""
    turn: Float[np.ndarray, "time"]
    """Turn rate to the left (rad/s)."""

    @classmethod
    def of(cls, body: Body, start_s: float, stop_s: float) -> "_BodyPath":
        times = np.linspace(start_s, stop_s, max(int((stop_s - start_s) / GRID_S), 2) + 1)
        place = body(times)
        step = times[1] - times[0]
        x, y, turn = blur(np.gradient(place, step, axis=0), 0.12, 1.0 / step).T
        cos, sin = np.cos(place[:, 2]), np.sin(place[:, 2])
        return cls(times, place, cos * x + sin * y, cos * y - sin * x, turn)

    def at(self, name: str, time: float) -> float:
        return float(np.interp(time, self.times, getattr(self, name)))

    def landings(
        self, plan: Plan, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "step"], Float[np.ndarray, "step"]]:
        """Landing times of the feet, and each step's duration (s); the last step closes the feet."""
        effort = np.hypot(self.ahead, self.aside) + TURNED_M * np.abs(self.turn)
        beat = np.clip(0.42 + 0.06 / np.maximum(effort, STILL), 0.45, 1.0) / plan.style.briskness**0.5
        beat = np.clip(beat, 0.42, 1.1)
        rate = ease((effort - STILL) / STILL) / beat
        phase = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(self.times))])
        if np.trapezoid(effort, self.times) < 0.04:
            return np.zeros(0), np.zeros(0)
        count = max(round(phase[-1]), 1)
        rising = phase + 1e-6 * np.arange(len(phase))
        wanted = (np.arange(1, count + 1) - 0.25) / count * phase[-1]
        lands = np.interp(wanted, rising, self.times)
        beats = np.interp(lands, self.times, beat)
        lands = np.append(lands, lands[-1] + 0.9 * beats[-1])
        beats = np.append(beats, min(beats[-1], 0.75))
        noise = 1.2 * plan.style.gait.variability * rng.standard_normal(len(lands)) * beats
        lands = np.maximum.accumulate(lands + noise)
        first = max(plan.time, self.times[0] - 0.2) + 0.75 * beats[0]
        least = first + np.concatenate([[0.0], np.cumsum(0.82 * beats[1:])])
        return np.maximum(lands, least), beats

    def first_foot(self, plan: Plan, rng: np.random.Generator) -> str:
        """The foot on the side to which it goes or turns, else the one behind, else either."""
        half = len(self.times) // 2
        aside = np.trapezoid(self.aside[:half], self.times[:half])
        aside += TURNED_M * np.trapezoid(self.turn[:half], self.times[:half])
        if abs(aside) > 0.08:
            return "left" if aside > 0 else "right"
        cos, sin = np.cos(plan.heading), np.sin(plan.heading)
        gap = plan.prints["left"][-1].ground - plan.prints["right"][-1].ground
        lead = float(gap[0] * cos + gap[1] * sin) * np.sign(np.trapezoid(self.ahead, self.times))
        if abs(lead) > 0.06:
            return "right" if lead > 0 else "left"
        return SIDES[int(rng.random() < 0.5)]

    def step(
        self, plan: Plan, side: str, timing: tuple[float, float, float], middle: float, rng: np.random.Generator
    ) -> None:
        """One step whose stance has its middle at a time; `timing` is its landing, swing and the steps' interval (s)."""
        land, swing, beat = timing
        gait, (x, y, heading) = plan.style.gait, (np.interp(middle, self.times, column) for column in self.place.T)
        across, ahead = abs(self.at("aside", middle)) * beat, self.at("ahead", middle)
        half = max(gait.stance_width, across + CLOSE_M) / 2 * (1.0 + gait.variability * rng.standard_normal())
        center = np.array([x, y, plan.position[2]])
        center[:2] += 0.008 * rng.standard_normal(2)
        size = float(np.clip(2.0 * abs(ahead) * beat, 0.0, 0.45))
        land_pitch = -0.35 * size if ahead > 0 else 0.5 * size
        how = {"land_pitch": land_pitch, "clearance": 0.02 + 0.03 * size, "bow": LEFT_SIGN[side] * 0.012}
        print_ = plan.footprint(side, center, heading, half, **how)
        old, other = plan.prints[side][-1], plan.prints[OTHER[side]][-1]
        lift = max(land - swing, old.land_s + 0.2, other.land_s + APART_S)
        stride = float(np.linalg.norm((print_.ground - old.ground)[:2]))
        lift_pitch = 0.75 * min(stride, 0.6) if self.at("ahead", lift) > 0.02 else 0.12
        plan.step(side, lift, max(land, lift + 0.3), lift_pitch, print_)


def shuffle(plan: Plan, rng: np.random.Generator, body: Body, start_s: float, stop_s: float) -> None:
    """Follow a body's path from one time to another with alternate steps, feet together at its end.

    Each foot lands at the body's place in the middle of its stance. `plan.time` becomes the last landing, at most
    about half a second after the path's end.
    """
    path = _BodyPath.of(body, start_s, stop_s)
    lands, beats = path.landings(plan, rng)
    side = path.first_foot(plan, rng) if len(lands) else ""
    for k, (land, beat) in enumerate(zip(lands, beats)):
        swing = beat * float(np.clip(0.66 + 0.05 * rng.standard_normal(), 0.55, 0.78))
        last, following = k >= len(lands) - 2, lands[min(k + 2, len(lands) - 1)]
        middle = stop_s if last else 0.5 * (land + following - swing)
        path.step(plan, side, (land, swing, beat), middle, rng)
        side = OTHER[side]
    plan.time = max(plan.time, stop_s)


def step_to(plan: Plan, rng: np.random.Generator, place: Float[np.ndarray, "2"], heading: float) -> None:
    """Bring the feet beside each other to a place nearby (m) and a heading (rad), in small steps."""
    start = np.append(plan.position[:2], plan.heading)
    change = np.append(place - start[:2], wrap(heading - start[2]))
    effort = float(np.linalg.norm(change[:2]) + TURNED_M * abs(change[2]))
    if effort < 0.03:
        return
    duration, begin = max(1.5 * effort / NEARBY_SPEED, 0.7), plan.time + 0.15
    body = lambda times: start + ease((times - begin) / duration)[:, None] * change  # noqa: E731
    shuffle(plan, rng, body, begin, begin + duration)


def arrive(plan: Plan, rng: np.random.Generator, place: Float[np.ndarray, "3"]) -> None:
    """Step to x, y (m) and a heading (rad) nearby, unless one is there."""
    if np.hypot(*(place[:2] - plan.position[:2])) > 0.03 or abs(wrap(place[2] - plan.heading)) > 0.1:
        step_to(plan, rng, place[:2], place[2])
