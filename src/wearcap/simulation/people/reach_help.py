"""Trunk motion that helps a gripping hand whose goal is beyond the arm's reach."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from wearcap.simulation.people.arms import arm_bones, held_wrist, shoulder_girdle
from wearcap.simulation.people.gait import FootMotion
from wearcap.simulation.people.plan import SIDES, Plan
from wearcap.simulation.people.posture import HELP, Spine, Stance, Trunk, spine_motion, trunk_motion
from wearcap.simulation.people.track import blur, ease, lower_envelope

REACH = 0.955
"""Share of the arm's length from which on the trunk helps."""
EASY = np.array([0.36, 0.10, 0.24, 0.04, 0.09, 0.06])
"""Ease of using each of `HELP` (rad, m)."""
LOW_EASY, LOW_M, LOW_BY_M = 0.13, 0.78, 0.40
"""Knees bend more readily (m) for goals that are lower above the floor than the first by up to the second (m)."""
MOST = np.array([0.9, 0.3, 0.6, 0.45, 0.30, 0.20])
ENVELOPE_S = 0.30
ROUNDS, SMOOTH_ROUNDS, EAGER = 6, 3, 1.2


def reach_help(
    plan: Plan, feet: dict[str, FootMotion], stance: Stance, times: Float[np.ndarray, "time"], fps: float
) -> Float[np.ndarray, "time 6"] | None:
    """Additional trunk motion, columns as `HELP`, smooth; None where nothing is held.

    Each moment's lack of reach is shared among the trunk's degrees of freedom by least squares (each weighted by its
    ease), in rounds, since reach is not linear; smooth curves cover the result, and a few more rounds, with smooth
    lacks, cover what these leave open.
    """
    if not any(plan.grips.values()):
        return None
    wanted = np.zeros((len(times), len(HELP)))
    crouch = plan.crouch.sample(times)[:, 0]
    easy = np.tile(EASY, (len(times), 1))
    easy[:, 3] += LOW_EASY * _low(plan, feet, stance, times, fps)
    for number in range(ROUNDS + SMOOTH_ROUNDS):
        if number == ROUNDS:
            wanted = _over(np.maximum(wanted, 0.0), fps) - _over(np.maximum(-wanted, 0.0), fps)
        trunk = trunk_motion(plan, feet, stance, times, fps, MOST * np.tanh(wanted / MOST))
        spine = spine_motion(plan.skeleton, trunk)
        smooth = number >= ROUNDS
        lacks, gains = zip(*(_lack(plan, side, spine, trunk, times, fps, smooth) for side in SIDES))
        if smooth and max(float(lack.max()) for lack in lacks) < 1e-4:
            break
        step = _shared(np.stack(lacks, 1), np.stack(gains, 1), easy)
        step[:, 3] = np.maximum(step[:, 3], -crouch - wanted[:, 3])
        wanted = wanted + EAGER * step
    return MOST * np.tanh(wanted / MOST)


def _over(need: Float[np.ndarray, "time column"], fps: float) -> Float[np.ndarray, "time column"]:
    """Smooth curves that are nowhere below the needs."""
    return np.stack([-lower_envelope(-column, ENVELOPE_S, fps) for column in need.T], 1)


def _low(
    plan: Plan, feet: dict[str, FootMotion], stance: Stance, times: np.ndarray, fps: float
) -> Float[np.ndarray, "time"]:
    """Weight of low goals of the hands, smooth."""
    spine = spine_motion(plan.skeleton, trunk_motion(plan, feet, stance, times, fps))
    floor = np.minimum(*(feet[side].ground[:, 2] for side in SIDES))
    low = np.zeros(len(times))
    for side in SIDES:
        held = held_wrist(plan, side, spine.chest, times)
        below = ease((LOW_M - (held.wrist[:, 2].numpy() - floor)) / LOW_BY_M)
        low = np.maximum(low, below * held.near.numpy())
    return blur(low, ENVELOPE_S, fps)


def _lack(
    plan: Plan, side: str, spine: Spine, trunk: Trunk, times: np.ndarray, fps: float, smooth: bool
) -> tuple[Float[np.ndarray, "time"], Float[np.ndarray, "time 6"]]:
    """Distance (m) by which a hand's goal is out of reach, and how much nearer each of `HELP` brings the shoulder."""
    bones = arm_bones(plan.skeleton, side)
    held = held_wrist(plan, side, spine.chest, times)
    girdle = shoulder_girdle(plan, side, trunk, spine.chest, held.wrist, held.weight)
    offset = held.wrist - girdle.at_shoulder
    distance = offset.norm(dim=-1)
    lack = ((distance - REACH * bones.length).clamp(min=0) * held.weight).numpy()
    toward = (offset / distance[:, None].clamp(min=1e-6)).numpy()
    if smooth:
        lack = _over(lack[:, None], fps)[:, 0]
    # A hand within reach should have little weight against the other hand's needs.
    counts = held.near.numpy() * (0.12 + 0.88 * ease(lack / 0.06))
    return counts * lack, counts[:, None] * _gains(plan, spine, trunk, girdle.at_shoulder, toward)


def _gains(
    plan: Plan, spine: Spine, trunk: Trunk, shoulder: Float[Tensor, "time 3"], toward: Float[np.ndarray, "time 3"]
) -> Float[np.ndarray, "time 6"]:
    """Motion of the shoulder along `toward` per unit of each of `HELP`: lever arms of pelvis and chest."""
    zero = np.zeros_like(trunk.heading)
    ahead = np.stack([np.cos(trunk.heading), np.sin(trunk.heading), zero], 1)
    left = np.stack([-ahead[:, 1], ahead[:, 0], zero], 1)
    up = np.stack([zero, zero, zero + 1.0], 1)
    chest = spine.t_world_chest.numpy()
    above, low = shoulder.numpy() - chest, chest - trunk.pelvis
    turns = [(left, 0.72, -0.26 * plan.hip_height), (ahead, 0.6, 0.0), (up, 0.65, 0.0)]
    moves = [np.cross(axis, above + share * low) + back * ahead for axis, share, back in turns]
    moves += [-up, ahead, left]
    return np.stack([(move * toward).sum(1) for move in moves], 1)


def _shared(
    lack: Float[np.ndarray, "time hand"], gain: Float[np.ndarray, "time hand 6"], easy: Float[np.ndarray, "time 6"]
) -> Float[np.ndarray, "time 6"]:
    """The least effort that brings both hands within reach: W² Gᵀ (G W² Gᵀ + ε)⁻¹ lack."""
    weighed = gain * easy[:, None] ** 2
    normal = weighed @ gain.transpose(0, 2, 1) + 4e-4 * np.eye(2)
    return (weighed * np.linalg.solve(normal, lack[..., None])).sum(1)
