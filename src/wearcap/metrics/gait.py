"""The knee while people walk and stand, beside that of healthy adults: what shows legs that are too long for their body."""

from functools import cache
from itertools import pairwise

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.skeleton import SIDES
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording.motion import Motion

POINTS = 101
"""Points of a gait cycle."""
HEEL_STRIKE = 0.27
"""Share of the cycle from one peak of swing to the next at which the heel strikes: the peak lies at 73 % from it."""
STANCE = slice(32, 73)
"""Points of a cycle that are 5 to 45 % from heel strike, when the foot bears weight: people's knees are bent by 4 to 18°."""
SPEED_M_S = (0.6, 1.9)
"""Mean speed of a cycle that is walked."""
_KNEE = ((0, 5, 12, 20, 30, 40, 50, 60, 70, 73, 80, 90, 97, 100), (5, 11, 18, 15, 8, 4, 10, 36, 60, 62, 55, 22, 4, 5))
_CYCLE_S = (0.7, 1.7)
_PEAK_DEG = 30.0
"""Least flexion of a swing's peak, also of people who hardly lift their feet."""
CROUCHED_DEG = 25.0
"""Flexion in stance from which somebody walks crouching."""
SEATED_DEG = 60.0
"""Flexion from which somebody upright who keeps still sits or squats."""
_LEVEL_M = 0.08
"""Change of a foot's height from swing to swing, and of the pelvis from cycle to cycle, on level ground."""


@cache
def normal_knee_deg() -> Float[Tensor, "point"]:
    """Flexion (degrees) from peak of swing to peak of swing of healthy adults on level ground (Perry & Burnfield; Winter)."""
    share = (np.linspace(0, 1, POINTS) - HEEL_STRIKE) % 1.0
    return torch.from_numpy(np.interp(100 * share, *_KNEE)).float()


def knee_deg(motion: Motion) -> Float[Tensor, "time side"]:
    """Flexion (degrees, 0 straight) of both knees, from the places of hip, knee and ankle."""
    hip, knee, ankle = (
        torch.stack([motion.joint(f"{side}_{name}").t for side in SIDES], 1).double()
        for name in ("hip", "knee", "ankle")
    )
    thigh, shank = knee - hip, ankle - knee
    across = torch.linalg.cross(thigh, shank).norm(dim=-1)
    return torch.atan2(across, (thigh * shank).sum(-1)).rad2deg().float()


def cycle_times(motion: Motion) -> list[Float64[Tensor, "cycle point"]]:
    """Times (s) of the points of all cycles in which the left and the right knee walk straight ahead on level ground."""
    pelvis = motion.joint("pelvis")
    path, ahead = pelvis.t.double().numpy(), pelvis.R[..., 0].double().numpy()
    times, flexion = motion.timestamps.numpy(), knee_deg(motion).numpy()
    found = []
    for k, side in enumerate(SIDES):
        ankle, cycles = motion.joint(f"{side}_ankle").t[:, 2].numpy(), []
        peaks, _ = scipy.signal.find_peaks(
            flexion[:, k], _PEAK_DEG, distance=max(round(0.45 * motion.fps), 1), prominence=15
        )
        for start, stop in pairwise(peaks.tolist()):
            seconds, gone = times[stop] - times[start], path[stop] - path[start]
            steps = np.linalg.norm(np.diff(path[start : stop + 1, :2], axis=0), axis=-1).sum()
            far = np.linalg.norm(gone[:2])
            level = max(abs(ankle[stop] - ankle[start]), abs(gone[2])) < _LEVEL_M
            walked = _CYCLE_S[0] < seconds < _CYCLE_S[1] and SPEED_M_S[0] < far / seconds < SPEED_M_S[1]
            forward = ahead[start : stop + 1].mean(0) @ gone > 0.8 * far
            if level and walked and forward and far > 0.9 * steps:
                cycles.append(np.linspace(times[start], times[stop], POINTS))
        found.append(torch.from_numpy(np.array(cycles).reshape(-1, POINTS)).double())
    return found


def knees_over(motion: Motion, cycles: list[Float64[Tensor, "_ point"]]) -> list[Float[Tensor, "_ point"]]:
    """Flexion (degrees) of left and right knees at the times of cycles, which may be another motion's on the same clock."""
    return [interpolate_clamped(motion.timestamps, flexion, at) for flexion, at in zip(knee_deg(motion).T, cycles)]


def knee_cycles(motion: Motion) -> list[Float[Tensor, "_ point"]]:
    """Flexion (degrees) of left and right knees over `cycle_times`, from peak of swing to peak of swing."""
    return knees_over(motion, cycle_times(motion))


def walking_scores(motion: Motion, cycles: list[Float64[Tensor, "_ point"]]) -> dict[str, float]:
    """`stance_knee_deg`, the median over cycles of the mean flexion in `STANCE`, and `knee_curve_rms_deg`, the deviation
    of the mean curve from the normal one; none without a cycle."""
    curves = torch.cat(knees_over(motion, cycles))
    if not len(curves):
        return {}
    off = (curves.mean(0) - normal_knee_deg()).square().mean().sqrt()
    return {"stance_knee_deg": curves[:, STANCE].mean(1).median().item(), "knee_curve_rms_deg": off.item()}


def crouches(motion: Motion) -> float | None:
    """The median knee in stance (degrees) of a motion that walks on knees more bent than people's; None of others."""
    knee_deg = walking_scores(motion, cycle_times(motion)).get("stance_knee_deg", 0.0)
    return knee_deg if knee_deg > CROUCHED_DEG else None


def standing(motion: Motion) -> Bool[Tensor, "time"]:
    """Frames in which somebody stands upright and quietly: ankles and pelvis are still, the trunk is upright, nobody sits."""
    still = torch.zeros(len(motion), dtype=torch.bool)
    if len(motion) < 3:
        return still
    names = ("left_ankle", "right_ankle", "pelvis", "head")
    t = torch.stack([motion.joint(name).t for name in names], 1)
    step_s = (motion.timestamps[2:] - motion.timestamps[:-2]).to(t)[:, None]
    slow = ((t[2:] - t[:-2]).norm(dim=-1) / step_s < torch.tensor([0.1, 0.1, 0.15, 0.3])).all(1)
    pelvis, trunk = t[:, 2], torch.nn.functional.normalize(t[:, 3] - t[:, 2], dim=-1)
    legs = (pelvis - t[:, :2].mean(1)).norm(dim=-1)
    apart = (t[:, 0] - t[:, 1])[:, :2].norm(dim=-1)
    even = (t[:, 0, 2] - t[:, 1, 2]).abs() < 0.05
    still[1:-1] = slow
    return still & (trunk[:, 2] > 0.95) & (apart < 0.5 * legs) & even & (knee_deg(motion) < SEATED_DEG).all(1)
