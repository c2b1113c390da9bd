"""Statistics of walking that do not depend on a skeleton's conventions: they use joint positions alone.

Everything is brought to 30 Hz first, so that rates and marker noise above 15 Hz do not decide.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.metrics.gait import HEEL_STRIKE, POINTS, cycle_times, knees_over, normal_knee_deg
from wearcap.recording import Motion, Recording

FPS = 30
WINDOW = 2 * FPS
HOP = FPS
JOINTS = (
    "pelvis",
    "head",
    *(
        f"{side}_{name}"
        for side in ("left", "right")
        for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe")
    ),
)

SPEEDS_M_S = (0.6, 0.95, 1.2, 1.45, 1.9)
"""Bounds of the speeds by which curves of walking are averaged."""
FLIGHT = 0.04
"""Share of a cycle in which neither foot touches the floor, from which on it is run."""
_NORMAL = {
    "hip": ((0, 12, 31, 50, 62, 75, 87, 100), (20, 20, 0, -20, -10, 15, 25, 20)),
    "ankle": ((0, 7, 12, 31, 48, 62, 75, 87, 100), (0, -5, 0, 5, 10, -15, -5, 0, 0)),
}
"""Thigh against the vertical (flexion) and foot against the shank (dorsiflexion) of healthy adults at 1.3 to 1.4 m/s
(degrees), at % from heel strike: the ends of the phases as in J. Perry and J. M. Burnfield, Gait Analysis, 2010 (chapters
on ankle, hip and total limb), with straight lines between them."""


@dataclass(frozen=True)
class Clip:
    """What is compared of one recording, at 30 Hz."""

    person: str
    joints: dict[str, Float[Tensor, "time 3"]]
    R_world_head: Float[Tensor, "time 3 3"]
    floor: Float[Tensor, "time"]
    stature: float


def clip_of(recording: Recording) -> Clip:
    """True joints of a recording, every pair of frames (at 60 Hz) averaged into one."""
    motion = recording.motion
    assert motion is not None
    step = round(motion.fps / FPS)
    count = len(motion) // step * step
    average = lambda value: value[:count].unflatten(0, (-1, step)).mean(1)  # noqa: E731
    pose: Rigid = motion.T_world_joint
    floor = recording.floor.height if recording.floor is not None else torch.zeros(len(motion))
    return Clip(
        recording.subject,
        {name: average(pose.t[:, motion.skeleton.index(name)]) for name in JOINTS},
        motion.joint("head").R[:count:step],
        average(floor),
        motion.skeleton.height_of("head"),
    )


def normal_curves() -> dict[str, Float[Tensor, "point"]]:
    """Knee, hip and ankle of healthy adults (degrees) from peak to peak of the knee's swing."""
    share = 100 * ((np.linspace(0, 1, POINTS) - HEEL_STRIKE) % 1.0)
    others = {name: torch.from_numpy(np.interp(share, *points)).float() for name, points in _NORMAL.items()}
    return {"knee": normal_knee_deg()} | others


def walking_curves(motion: Motion) -> dict[str, Float[Tensor, "cycle *point"]]:
    """Knee, hip and ankle (degrees) over all cycles of level walking of both legs, and each cycle's speed (m/s)."""
    ahead = torch.nn.functional.normalize(motion.joint("pelvis").R[..., :2, 0], dim=-1)
    cycles = [times[[not _is_run(motion, cycle) for cycle in times]] for times in cycle_times(motion)]
    found = {"knee": knees_over(motion, cycles), "hip": [], "ankle": [], "speed": []}
    for side, times in zip(("left", "right"), cycles):
        knee, ankle, toe = (motion.joint(f"{side}_{name}").t for name in ("knee", "ankle", "toe"))
        thigh = knee - motion.joint(f"{side}_hip").t
        hip = torch.atan2((thigh[:, :2] * ahead).sum(-1), -thigh[:, 2])
        upper, lower = motion.skeleton.t_parent_joint[motion.skeleton.indices(f"{side}_ankle", f"{side}_toe")]
        bent = _between(-upper, lower) - _between(knee - ankle, toe - ankle)
        for name, angle in (("hip", hip), ("ankle", bent)):
            found[name].append(interpolate_clamped(motion.timestamps, angle.rad2deg(), times))
        ends = interpolate_clamped(motion.timestamps, motion.t_world_root, times[:, [0, -1]])
        found["speed"].append((ends[:, 1] - ends[:, 0])[:, :2].norm(dim=-1) / (times[:, -1] - times[:, 0]))
    return {name: torch.cat(sides).float() for name, sides in found.items()}


def _is_run(motion: Motion, times: Float[Tensor, "point"]) -> bool:
    within = (motion.timestamps >= times[0]) & (motion.timestamps <= times[-1])
    if motion.contact_prob is None:
        return False
    return bool((motion.contact_prob[within] < 0.5).all(1).float().mean() > FLIGHT)


def curve_deviations(motions: Iterable[Motion]) -> dict[str, dict[str, float]]:
    """By range of speed: recordings with such cycles, and of knee, hip and ankle the median over them of the rms (degrees)
    by which the mean curve is off the normal one, and the largest of the knee's."""
    normal, measured = normal_curves(), [walking_curves(motion) for motion in motions]
    rows = {}
    for low, high in pairwise(SPEEDS_M_S):
        off = {name: [] for name in normal}
        for curves in measured:
            chosen = (curves["speed"] >= low) & (curves["speed"] < high)
            for name in normal if chosen.sum() >= 2 else ():
                off[name].append((curves[name][chosen].mean(0) - normal[name]).square().mean().sqrt().item())
        if off["knee"]:
            row = {f"{name}_rms_deg": float(np.median(values)) for name, values in off.items()}
            rows[f"{low} to {high} m/s"] = {"recordings": len(off["knee"])} | row | {"worst_knee_deg": max(off["knee"])}
    return rows


def windows_of(value: Float[Tensor, "time *rest"]) -> Float[Tensor, "window frame *rest"]:
    """Overlapping windows of 2 s."""
    if len(value) < WINDOW:
        return value.new_zeros(0, WINDOW, *value.shape[1:])
    return value.unfold(0, WINDOW, HOP).movedim(-1, 1)


def walking_windows(clips: list[Clip]) -> dict[str, Float[Tensor, "window"]]:
    """Statistics of all windows of straight walking, by name with unit."""
    parts = [statistics(clip) for clip in clips]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def is_walking(clip: Clip) -> Bool[Tensor, "window"]:
    """Windows in which the pelvis goes straight on (its halves within 4°), upright, at a walking speed, never stopping."""
    pelvis = windows_of(clip.joints["pelvis"])
    step = pelvis[:, 1:, :2] - pelvis[:, :-1, :2]
    net = (pelvis[:, -1, :2] - pelvis[:, 0, :2]).norm(dim=-1)
    speed, arc = net * FPS / (WINDOW - 1), step.norm(dim=-1).sum(1)
    height = pelvis[..., 2].amax(1) - pelvis[..., 2].amin(1)
    slowest = step.norm(dim=-1).amin(1) * FPS
    middle = pelvis[:, WINDOW // 2, :2]
    turned = _between(
        *(torch.nn.functional.pad(half, (0, 1)) for half in (middle - pelvis[:, 0, :2], pelvis[:, -1, :2] - middle))
    )
    straight = (net > 0.97 * arc) & (turned.rad2deg() < 4)
    return (speed > 0.6) & (speed < 1.9) & straight & (height < 0.12) & (slowest > 0.3)


def statistics(clip: Clip) -> dict[str, Float[Tensor, "window"]]:
    """Gait statistics of a clip's walking windows."""
    chosen = is_walking(clip)
    joint = {name: windows_of(value)[chosen] for name, value in clip.joints.items()}
    pelvis = joint["pelvis"]
    forward = torch.nn.functional.normalize((pelvis[:, -1] - pelvis[:, 0]) * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    left = torch.stack([-forward[:, 1], forward[:, 0], 0 * forward[:, 0]], -1)
    along = lambda value, axis: (value * axis[:, None]).sum(-1)  # noqa: E731
    speed = along(pelvis[:, -1:] - pelvis[:, :1], forward)[:, 0] * FPS / (WINDOW - 1)
    stride_hz = dominant_frequency(along(joint["left_ankle"] - joint["right_ankle"], forward))
    head_above_floor = joint["head"][..., 2] - windows_of(clip.floor)[chosen]
    R_head = windows_of(clip.R_world_head)[chosen]
    found = {
        "speed_m_s": speed,
        "cadence_steps_min": 120 * stride_hz,
        "step_length_m": speed / (2 * stride_hz),
        "pelvis_vertical_cm": 100 * peak_to_peak(pelvis[..., 2]),
        "pelvis_lateral_cm": 100 * peak_to_peak(along(pelvis, left)),
        "head_vertical_cm": 100 * peak_to_peak(joint["head"][..., 2]),
        "head_height_share": head_above_floor.mean(1) / clip.stature,
        "head_pitch_down_deg": R_head[..., 2, 0].clamp(-1, 1).asin().mean(1).neg().rad2deg(),
        "head_yaw_spread_deg": _yaw_spread(R_head),
        "head_jerk_m_s3": jerk(joint["head"]),
        "pelvis_jerk_m_s3": jerk(pelvis),
    }
    for name in ("wrist", "ankle"):
        found[f"{name}_jerk_m_s3"] = 0.5 * (jerk(joint[f"left_{name}"]) + jerk(joint[f"right_{name}"]))
    for name, angles in _limb_angles(joint, along, forward).items():
        found[f"{name}_range_deg"] = (angles.amax(-1) - angles.amin(-1)).rad2deg().mean(0)
    return found


def _limb_angles(joint: dict[str, Tensor], along, forward: Tensor) -> dict[str, Float[Tensor, "side window frame"]]:
    """Thigh and upper arm against the vertical in the plane of walking; knee, ankle and elbow between bones."""
    bones = {"hip": ("hip", "knee"), "shoulder": ("shoulder", "elbow")}
    hinges = {
        "knee": ("hip", "knee", "ankle"),
        "ankle": ("knee", "ankle", "toe"),
        "elbow": ("shoulder", "elbow", "wrist"),
    }
    found: dict[str, list[Tensor]] = {name: [] for name in (*bones, *hinges)}
    for side in ("left", "right"):
        at = lambda name, side=side: joint[f"{side}_{name}"]  # noqa: E731
        for name, (top, bottom) in bones.items():
            bone = at(bottom) - at(top)
            found[name].append(torch.atan2(along(bone, forward), -bone[..., 2]))
        for name, (a, b, c) in hinges.items():
            found[name].append(_between(at(a) - at(b), at(c) - at(b)))
    return {name: torch.stack(sides) for name, sides in found.items()}


def _between(a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def _yaw_spread(R_head: Float[Tensor, "window frame 3 3"]) -> Float[Tensor, "window"]:
    """Standard deviation of the head's heading in each window (degrees)."""
    yaw = rotation.yaw_of(R_head)
    turned = rotation.wrap_angle(yaw - yaw[:, :1])
    return (turned - turned.mean(1, keepdim=True)).square().mean(1).sqrt().rad2deg()


def peak_to_peak(value: Float[Tensor, "window frame"]) -> Float[Tensor, "window"]:
    """Range around each window's own straight line."""
    line = torch.linspace(-1, 1, value.shape[1])
    centred = value - value.mean(1, keepdim=True)
    centred = centred - (centred @ line / line.square().sum())[:, None] * line
    return centred.amax(1) - centred.amin(1)


def jerk(position: Float[Tensor, "window frame 3"]) -> Float[Tensor, "window"]:
    """Mean length of the third difference of position (m/s³)."""
    return position.double().diff(n=3, dim=1).norm(dim=-1).mean(1).float() * FPS**3


def dominant_frequency(
    value: Float[Tensor, "window frame"], lowest: float = 0.5, highest: float = 1.5
) -> Float[Tensor, "window"]:
    """Frequency (Hz) of the sinusoid that leaves the least of each window after least squares."""
    t = torch.arange(value.shape[1]) / FPS
    candidates = torch.arange(lowest, highest, 0.01)
    left = []
    for frequency in candidates.tolist():
        phase = 2 * math.pi * frequency * t
        basis = torch.stack([phase.cos(), phase.sin(), torch.ones_like(t)], -1)
        Q = torch.linalg.qr(basis).Q
        left.append((value - value @ Q @ Q.T).square().sum(1))
    return candidates[torch.stack(left).argmin(0)]
