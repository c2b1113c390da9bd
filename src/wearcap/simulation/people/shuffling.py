"""Small steps that carry the body along any path: forwards, backwards, sideways, turning."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wearcap.simulation.people.plan import LEFT_SIGN, OTHER, SIDES, Plan, wrap
from wearcap.simulation.people.track import blur, ease

Body = Callable[[Float[np.ndarray, "time"]], Float[np.ndarray, "time 3"]]
"""x, y (m) and unwrapped heading (rad) of the floor point between the feet at times (s)."""

GRID_S = 0.02
SPEED = 0.45
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

    def place_at(self, time: float) -> Float[np.ndarray, "3"]:
        return np.array([np.interp(time, self.times, column) for column in self.place.T])


def shuffle(plan: Plan, rng: np.random.Generator, body: Body, start_s: float, stop_s: float) -> None:
    """Follow a body's path from one time to another with alternate steps, feet together at its end.

    Each foot lands at the body's place in the middle of its stance. `plan.time` becomes the last landing, at most
    about half a second after the path's end.
    """
    path = _BodyPath.of(body, start_s, stop_s)
    lands, beats = _landings(plan, path, rng)
    side = _first_foot(plan, path, rng) if len(lands) else ""
    for k, (land, beat) in enumerate(zip(lands, beats)):
        swing = beat * float(np.clip(0.66 + 0.05 * rng.standard_normal(), 0.55, 0.78))
        last, following = k >= len(lands) - 2, lands[min(k + 2, len(lands) - 1)]
        middle = stop_s if last else 0.5 * (land + following - swing)
        _step(plan, path, side, (land, swing, beat), middle, rng)
        side = OTHER[side]
    plan.time = max(plan.time, stop_s)


def step_to(plan: Plan, rng: np.random.Generator, place: Float[np.ndarray, "2"], heading: float) -> None:
    """Bring the feet beside each other to a place nearby (m) and a heading (rad), in small steps."""
    start = np.append(plan.position[:2], plan.heading)
    change = np.append(place - start[:2], wrap(heading - start[2]))
    effort = float(np.linalg.norm(change[:2]) + TURNED_M * abs(change[2]))
    if effort < 0.03:
        return
    duration, begin = max(1.5 * effort / SPEED, 0.7), plan.time + 0.15
    body = lambda times: start + ease((times - begin) / duration)[:, None] * change  # noqa: E731
    shuffle(plan, rng, body, begin, begin + duration)


def arrive(plan: Plan, rng: np.random.Generator, place: Float[np.ndarray, "3"]) -> None:
    """Step to x, y (m) and a heading (rad) nearby, unless one is there."""
    if np.hypot(*(place[:2] - plan.position[:2])) > 0.03 or abs(wrap(place[2] - plan.heading)) > 0.1:
        step_to(plan, rng, place[:2], place[2])


def _landings(
    plan: Plan, path: _BodyPath, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "step"], Float[np.ndarray, "step"]]:
    """Landing times of the feet, and each step's duration (s); the last step closes the feet."""
    effort = np.hypot(path.ahead, path.aside) + TURNED_M * np.abs(path.turn)
    beat = np.clip(0.42 + 0.06 / np.maximum(effort, STILL), 0.45, 1.0) / plan.style.briskness**0.5
    beat = np.clip(beat, 0.42, 1.1)
    rate = ease((effort - STILL) / STILL) / beat
    phase = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(path.times))])
    if np.trapezoid(effort, path.times) < 0.04:
        return np.zeros(0), np.zeros(0)
    count = max(round(phase[-1]), 1)
    rising = phase + 1e-6 * np.arange(len(phase))
    wanted = (np.arange(1, count + 1) - 0.25) / count * phase[-1]
    lands = np.interp(wanted, rising, path.times)
    beats = np.interp(lands, path.times, beat)
    lands = np.append(lands, lands[-1] + 0.9 * beats[-1])
    beats = np.append(beats, min(beats[-1], 0.75))
    noise = 1.2 * plan.style.gait.variability * rng.standard_normal(len(lands)) * beats
    lands = np.maximum.accumulate(lands + noise)
    first = max(plan.time, path.times[0] - 0.2) + 0.75 * beats[0]
    least = first + np.concatenate([[0.0], np.cumsum(0.82 * beats[1:])])
    return np.maximum(lands, least), beats


def _first_foot(plan: Plan, path: _BodyPath, rng: np.random.Generator) -> str:
    """The foot on the side to which it goes or turns, else the one behind, else either."""
    half = len(path.times) // 2
    aside = np.trapezoid(path.aside[:half], path.times[:half])
    aside += TURNED_M * np.trapezoid(path.turn[:half], path.times[:half])
    if abs(aside) > 0.08:
        return "left" if aside > 0 else "right"
    cos, sin = np.cos(plan.heading), np.sin(plan.heading)
    gap = plan.prints["left"][-1].ground - plan.prints["right"][-1].ground
    lead = float(gap[0] * cos + gap[1] * sin) * np.sign(np.trapezoid(path.ahead, path.times))
    if abs(lead) > 0.06:
        return "right" if lead > 0 else "left"
    return SIDES[int(rng.random() < 0.5)]


def _step(
    plan: Plan, path: _BodyPath, side: str, timing: tuple[float, float, float], middle: float, rng: np.random.Generator
) -> None:
    """One step whose stance has its middle at a time; `timing` is its landing, swing and the steps' interval (s)."""
    land, swing, beat = timing
    gait, (x, y, heading) = plan.style.gait, path.place_at(middle)
    across, ahead = abs(path.at("aside", middle)) * beat, path.at("ahead", middle)
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
    lift_pitch = 0.75 * min(stride, 0.6) if path.at("ahead", lift) > 0.02 else 0.12
    plan.step(side, lift, max(land, lift + 0.3), lift_pitch, print_)
