"""Walking: smooth paths over the floor, and footsteps along them that meet the treads of stairs exactly."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from wearcap.simulation.people.gait import advance, bump, climb
from wearcap.simulation.people.plan import LEFT_SIGN, OTHER, SIDES, STEP_M, Footprint, Plan, step_rise, wrap
from wearcap.simulation.people.track import blur
from wearcap.simulation.places.outline import turn

SPACING_M = 0.02
RUN_SPEED = 2.1
JOG_SPEED = 1.4
"""Speed (m/s) from which on a person who intends to run does so: at the start, the end and in curves."""
ACCELERATION, BRAKING = 1.0, 0.85
END_SPEED = 0.32
MIN_CADENCE = 80.0
READY_S = 0.42
"""Time between the decision to walk and the first foot's lift, in which the weight moves to the other leg."""
CURVE_SPEED = 0.95
"""Speed (m/s) in a curve of radius 1 m, for a wearer whose own speed is 1.3 m/s (two-thirds power law)."""
HEEL_ROOM_M, TOE_ROOM_M, EDGE_M = 0.055, 0.015, 0.08
"""Margins on treads: heel behind the ankle, toes before the next riser, and, going down, the ankle past the edge."""
PAST_KERB_M = 0.16
"""Distance of the ankle beyond a kerb's edge after stepping over it."""


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
    def of(cls, plan: Plan, path: Float[np.ndarray, "waypoint 3"], speed: float, flights: tuple) -> "_Course":
        """Speed, time and step phase along a path. Steps fall on the treads of the flights that it takes."""
        points, heading = _rounded(path)
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
        limit = blur(_ramped(limit), 0.10, 1 / SPACING_M)
        stride = np.minimum(np.sqrt(60 * plan.style.gait.walk_ratio * limit), limit * 60 / MIN_CADENCE)
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
    plan: Plan, path: Float[np.ndarray, "waypoint 3"], rng: np.random.Generator, speed: float, flights: tuple = ()
) -> None:
    """Turn towards a path's start, walk (or run, above 2.1 m/s) along it and stop at its end, feet together."""
    course = _Course.of(plan, path, speed, flights)
    ahead = float(np.interp(0.35, np.arange(len(course.heading)) * SPACING_M, course.heading))
    if abs(wrap(ahead - plan.heading)) > np.deg2rad(50):
        turn_to(plan, ahead - np.sign(wrap(ahead - plan.heading)) * np.deg2rad(15), rng)
    steps = round(course.phase[-1])
    side = _first_foot(plan, wrap(course.at_phase("heading", 1.0) - plan.heading), rng)
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
            both = float(np.clip(0.24 + 0.16 * (1.3 - how), 0.14, 0.42))
        _walk_step(plan, side, land - beat * (1.0 - both) if k > 1 else land - 0.5, land, print_, running)
        side = OTHER[side]


def _walk_step(plan: Plan, side: str, lift: float, land: float, print_: Footprint, running: bool) -> None:
    """Add one step; the longer the stride, the more the foot rolls at its ends."""
    old = plan.prints[side][-1]
    lift = max(lift, old.land_s + 0.16)
    stride = float(np.linalg.norm((print_.ground - old.ground)[:2]))
    size = min(stride / 1.35, 1.15) * plan.style.gait.heel_rise
    rise = step_rise(old, print_)
    lift_pitch, land_pitch, clearance = (0.85, -0.10, 0.10) if running else (0.95 * size, -0.44 * size, 0.02)
    if rise > STEP_M:
        lift_pitch, land_pitch, clearance = 0.55, 0.06, 0.05
    elif rise < -STEP_M:
        lift_pitch, land_pitch, clearance = 0.60, 0.22, 0.03
    elif stride < 0.45:
        clearance = 0.03
    clearance = max(clearance, _over_corner(plan, old, print_, rise))
    swing = {"land_pitch": land_pitch, "clearance": clearance, "bow": LEFT_SIGN[side] * 0.012, "running": running}
    plan.step(side, lift, land, lift_pitch, replace(print_, **swing))


def _over_corner(plan: Plan, old: Footprint, new: Footprint, rise: float) -> float:
    """Height (m) to which a swing must lift the foot to clear a step or crest whose corner it cuts; 0 going down."""
    if rise < -STEP_M:
        return 0.0
    share = np.linspace(0.15, 0.8, 14)
    moved = advance(share, np.array(rise))
    ankle = old.ground + moved[:, None] * (new.ground - old.ground)
    heading = old.heading + share * wrap(new.heading - old.heading)
    toes = ankle[:, :2] + plan.sole[1] * np.stack([np.cos(heading), np.sin(heading)], 1)
    floor = plan.floor_height(toes, np.full(len(share), max(old.ground[2], new.ground[2])))
    line = old.ground[2] + (new.ground[2] - old.ground[2] - rise) * moved + rise * climb(np.array(rise), share)
    need = np.nan_to_num(floor - line, nan=0.0)
    least = STEP_M if rise > STEP_M else 0.002
    need = np.where(need > least, (need + 0.02) / bump(share), 0.0)
    return float(min(need.max(), 0.35))


def _rounded(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spaced points of a path with rounded corners, and its unwrapped heading."""
    run = np.concatenate([[0.0], np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).cumsum()])
    count = max(int(run[-1] / SPACING_M), 4)
    even = np.stack([np.interp(np.linspace(0, run[-1], count), run, column) for column in path.T], 1)
    reach = min(40, count - 1)
    padded = np.concatenate([2 * even[0] - even[reach:0:-1], even, 2 * even[-1] - even[-2 : -reach - 2 : -1]])
    padded[:, :2] = blur(padded[:, :2], 0.16, 1 / SPACING_M)
    points = padded[reach : reach + count]
    points[:, 2] = even[:, 2]
    slope = np.gradient(padded[:, :2], axis=0)[reach : reach + count]
    return points, np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))


def _ramped(limit: np.ndarray) -> np.ndarray:
    """The highest speeds under a limit that start and stop gently: v² changes by no more than 2 a ds."""
    squared = limit**2
    length = np.arange(len(limit)) * SPACING_M
    squared = np.minimum(squared, END_SPEED**2 + 2 * ACCELERATION * length)
    squared = np.minimum(squared, END_SPEED**2 + 2 * BRAKING * length[::-1])
    rise, fall = 2 * ACCELERATION * length, 2 * BRAKING * length
    squared = np.minimum.accumulate(squared - rise) + rise
    return np.sqrt(np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall)


def _tread_anchors(points: np.ndarray, flight, foot: float) -> list[tuple[float, int, float]]:
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


def _first_foot(plan: Plan, turned: float, rng: np.random.Generator) -> str:
    """The foot behind, else the inner one of a turn by an angle (rad), else either."""
    apart = (plan.prints["left"][-1].ground - plan.prints["right"][-1].ground)[:2]
    ahead = apart @ turn(plan.heading)[:, 0]
    if abs(ahead) > 0.1:
        return "right" if ahead > 0 else "left"
    if abs(turned) > 0.2:
        return "left" if turned > 0 else "right"
    return SIDES[int(rng.random() < 0.5)]


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
