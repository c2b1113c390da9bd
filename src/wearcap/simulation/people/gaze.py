"""Gaze: ahead of the coming turn, in saccades, and at objects that are reached for."""

import numpy as np
from jaxtyping import Float

from wearcap.simulation.people.plan import Plan, wrap
from wearcap.simulation.people.posture import Trunk
from wearcap.simulation.people.track import blur, wander

LEAD_S = 0.32
"""Lead of the gaze over a turn of the body."""
YAW_LIMIT = 1.15
PITCH_LIMITS = (-0.75, 0.95)


def look_about(
    plan: Plan, start_s: float, stop_s: float, rng: np.random.Generator, spread: float = 0.5, pause_s: float = 1.6
) -> None:
    """Head turns of 10 to 60 degrees every 1 to 4 s between two times, back to the front at the end.

    `spread` is the deviation of the yaw (rad), `pause_s` the mean pause between turns (s).
    """
    time = start_s + rng.uniform(0.2, 1.0) * pause_s
    pitch = plan.style.posture.head_pitch
    while time < stop_s - 1.2:
        yaw, down = rng.normal(0.0, spread), pitch + rng.normal(0.0, 0.35 * spread)
        if rng.random() < 0.3:
            yaw, down = 0.15 * yaw, pitch
        time = turn_head(plan, time, np.clip(yaw, -1.2, 1.2), np.clip(down, -0.5, 0.8))
        time += pause_s * (0.35 + rng.exponential(0.75))
    turn_head(plan, max(stop_s - 0.6, start_s))


def turn_head(plan: Plan, start_s: float, yaw: float = 0.0, pitch: float | None = None) -> float:
    """One head turn to a yaw and pitch (rad; None is the wearer's habit). Returns the time (s) at which it ends.

    Its duration grows with its size.
    """
    target = yaw, plan.style.posture.head_pitch if pitch is None else pitch
    size = float(np.abs(np.array(target) - plan.gaze.last).max())
    stop = start_s + (0.22 + 0.45 * size) / plan.style.briskness
    plan.gaze.move(start_s, stop, target)
    return stop


def look_at(
    plan: Plan, point: Float[np.ndarray, "3"], on: tuple[float, float], off: tuple[float, float], weight: float = 0.9
) -> None:
    """Turn the gaze to a point in the world (m) in one interval of time and off it in another (s)."""
    plan.gaze_point.move(on[0], on[0], point)
    plan.gaze_weight.visit(weight, on, off)


def head_angles(
    trunk: Trunk, eyes: Float[np.ndarray, "time 3"], rng: np.random.Generator
) -> Float[np.ndarray, "time 3"]:
    """Yaw, pitch (down positive) and roll of the head in the world (rad), given the approximate eye position (m).

    The head is stabilised against the trunk's swing but for a small share, and pitches against its own bob as eyes
    fixed on a point some metres ahead do.
    """
    stance, chest = trunk.stance, trunk.chest_angles
    plan, times, fps, heading = stance.feet.plan, stance.feet.times, stance.feet.fps, stance.heading
    lead = round(LEAD_S * fps)
    ahead = np.concatenate([heading[lead:], np.full(min(lead, len(heading)), heading[-1])])[: len(heading)]
    offset = plan.gaze.sample(times)
    bob = eyes[:, 2] - blur(eyes[:, 2], 0.6, fps)
    noise = wander(rng, len(times), 3, 0.9, 0.012, fps)
    steady = blur(chest, 0.5, fps)
    yaw = blur(ahead, 0.09, fps) + offset[:, 0] + 0.12 * (chest[:, 0] - steady[:, 0]) + noise[:, 0]
    pitch = offset[:, 1] + 0.10 * (chest[:, 1] - steady[:, 1]) + bob / 2.5 + noise[:, 1]
    pitch += 0.35 * np.clip(steady[:, 1] - 0.15, 0.0, None)
    point, weight = plan.gaze_point.sample(times) - eyes, plan.gaze_weight.sample(times)[:, 0]
    toward = np.arctan2(point[:, 1], point[:, 0])
    down = np.arctan2(-point[:, 2], np.linalg.norm(point[:, :2], axis=1))
    relative = yaw - chest[:, 0]
    relative += weight * (np.clip(wrap(toward - chest[:, 0]), -1.4, 1.4) - relative)
    pitch += weight * (down - pitch)
    relative = YAW_LIMIT * np.tanh(relative / YAW_LIMIT)
    middle, half = sum(PITCH_LIMITS) / 2, (PITCH_LIMITS[1] - PITCH_LIMITS[0]) / 2
    pitch = middle + half * np.tanh((pitch - middle) / half)
    return np.stack([chest[:, 0] + relative, pitch, 0.25 * chest[:, 2] + noise[:, 2]], 1)
