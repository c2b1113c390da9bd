"""Figures that show whether recorded motion is that of a person: knees, soles, jumps, sides, proportions, the head's pitch."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.metrics.gait import SPEED_M_S, STANCE, knee_cycles, knee_deg, normal_knee_deg, standing
from wearcap.metrics.physics import foot_contact, foot_points, foot_skate_cm_s
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording

LEAST_CYCLES = 4
"""Cycles of walking below which a person's mean curve says nothing."""
LEAST_S = 1.0
"""Time (s) of standing, or of walking in one recording, below which it says nothing."""
SEATED_DEG = 60.0
"""Knee from which somebody upright who keeps still sits."""
ROOT_M_S, JOINT_M_S = 8.0, 15.0
"""Speeds that neither the pelvis nor any joint of a person reaches, as `prepare`'s limits have them."""
_UPRIGHT = 0.9
_LEVEL_M = 0.01
_NAN = float("nan")


@dataclass(frozen=True)
class Truth:
    """Figures of one person's recordings; NaN where they hold nothing to measure."""

    minutes: float
    cycles: int
    """Cycles of straight, level walking."""
    knee_rms_deg: float
    """Deviation (rms) of the mean knee over the cycle from that of healthy adults."""
    stance_deg: float
    """Median knee while a walking foot bears weight."""
    standing_deg: float
    """Median knee while standing."""
    curves_deg: float
    """Difference (rms) of the left knee's mean curve from the right's."""
    bones_cm: float
    """Largest difference of a bone on the left from that on the right."""
    sole_cm: float
    """Median height of planted soles over the floor, negative through it."""
    sole_low_cm: float
    """5th percentile of the same."""
    sole_high_cm: float
    """95th percentile of the same."""
    skate_cm_s: float
    """Mean horizontal speed of planted feet."""
    jumps: float
    """Frames per minute in which a joint moves faster than any person's."""
    stature_m: float
    leg: float
    """Thigh and shank, as a share of stature."""
    eyes: float
    """Height of the head-mounted device in the rest pose, as a share of stature."""
    pitch_deg: float
    """Median over recordings of the head's mean pitch while walking, positive below the horizon."""
    pitch_spread_deg: float
    """Standard deviation of the same over recordings."""


def truth(recordings: Sequence[Recording]) -> Truth:
    """Figures of one person, from recordings with `motion`; contacts and a floor where they have them."""
    pairs = [(recording, recording.motion) for recording in recordings if recording.motion is not None]
    motions = [motion for _, motion in pairs]
    seconds = sum((motion.timestamps[-1] - motion.timestamps[0]).item() for motion in motions)
    heights = torch.cat([_sole_heights(recording, motion) for recording, motion in pairs])
    low, middle, high = _quantiles(100 * heights, 0.05, 0.5, 0.95)
    pitches = torch.tensor([value for motion in motions if (value := _walking_pitch_deg(motion)) is not None])
    spread = pitches.std().item() if len(pitches) > 1 else _NAN
    jumps = sum(int(_too_fast(motion).sum()) for motion in motions)
    return Truth(
        minutes=seconds / 60,
        **_knees(motions),
        bones_cm=_median([100 * _uneven_m(motion.skeleton) for motion in motions]),
        sole_cm=middle,
        sole_low_cm=low,
        sole_high_cm=high,
        skate_cm_s=_skate_cm_s(pairs),
        jumps=60 * jumps / seconds,
        stature_m=_median([motion.skeleton.stature for motion in motions]),
        leg=_median([_leg_m(motion.skeleton) / motion.skeleton.stature for motion in motions]),
        eyes=_median([_eyes_m(recording, motion) / motion.skeleton.stature for recording, motion in pairs]),
        pitch_deg=_quantiles(pitches, 0.5)[0],
        pitch_spread_deg=spread,
    )


def _knees(motions: Sequence[Motion]) -> dict:
    """`Truth`'s figures of the knees."""
    left, right = (torch.cat(side) for side in zip(*(knee_cycles(motion) for motion in motions)))
    both = torch.cat([left, right])
    knees = [knee_deg(motion) for motion in motions]
    stands = [standing(motion) & (knee < SEATED_DEG).all(1) for motion, knee in zip(motions, knees)]
    seconds = sum(int(mask.sum()) / motion.fps for motion, mask in zip(motions, stands))
    stood = torch.cat([knee[mask].flatten() for knee, mask in zip(knees, stands)])
    known, sides = len(both) >= LEAST_CYCLES, min(len(left), len(right)) >= LEAST_CYCLES
    return {
        "cycles": len(both),
        "knee_rms_deg": _rms(both.mean(0) - normal_knee_deg()) if known else _NAN,
        "stance_deg": both[:, STANCE].median().item() if known else _NAN,
        "standing_deg": stood.median().item() if seconds >= LEAST_S else _NAN,
        "curves_deg": _rms(left.mean(0) - right.mean(0)) if sides else _NAN,
    }


def _sole_heights(recording: Recording, motion: Motion) -> Float[Tensor, "patch"]:
    """Heights (m) over the floor of the soles' planted patches, where it is level for a second to either side; none
    without contacts or floor."""
    contact, floor = _feet(recording, motion.timestamps), recording.floor
    if contact is None or floor is None or not set(FOOT_PATCHES) <= set(motion.skeleton.sites):
        return torch.zeros(0)
    patches = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)[..., 2]
    around = torch.stack([floor.height[_nearest(floor.timestamps, motion.timestamps + s)] for s in (-1.0, 0.0, 1.0)])
    level = around.amax(0) - around.amin(0) < _LEVEL_M
    return (patches - around[1][:, None])[contact & level[:, None]]


def _skate_cm_s(pairs: Sequence[tuple[Recording, Motion]]) -> float:
    """Skating (cm/s) over all recordings with contacts, each by the time that its feet are planted."""
    total = count = 0.0
    for recording, motion in pairs:
        contact = _feet(recording, motion.timestamps)
        planted = None if contact is None else foot_contact(contact)
        if planted is not None and (frames := int((planted[1:] & planted[:-1]).sum())):
            points = foot_points(motion.skeleton, motion.T_world_joint)
            total, count = total + frames * foot_skate_cm_s(points, planted, motion.fps).item(), count + frames
    return total / count if count else _NAN


def _feet(recording: Recording, times: Float64[Tensor, "time"]) -> Bool[Tensor, "time patch"] | None:
    """Contacts of `FOOT_PATCHES` at these times, None where the recording has none."""
    track = recording.contacts
    feet = None if track is None else track.feet
    return None if track is None or feet is None else feet[_nearest(track.timestamps, times)]


def _nearest(timestamps: Float64[Tensor, "row"], times: Float64[Tensor, "time"]) -> Tensor:
    """Row of a track at each time: that at it, or the next."""
    return torch.searchsorted(timestamps, times).clamp(max=len(timestamps) - 1)


def _too_fast(motion: Motion) -> Bool[Tensor, "step"]:
    """Steps in which the root or a joint moves faster than any person's."""
    speed = motion.T_world_joint.t.diff(dim=0).norm(dim=-1) / motion.timestamps.diff().to(motion.t_world_root)[:, None]
    return (speed[:, 0] > ROOT_M_S) | (speed > JOINT_M_S).any(1)


def _walking_pitch_deg(motion: Motion) -> float | None:
    """Mean pitch (degrees below the horizon) of the head while it walks upright, None where it hardly does."""
    span = round(motion.fps)
    gone = (motion.t_world_root[span:] - motion.t_world_root[:-span])[:, :2].norm(dim=-1)
    head, pelvis = (motion.joint(name)[span // 2 : span // 2 + len(gone)] for name in ("head", "pelvis"))
    upright = torch.nn.functional.normalize(head.t - pelvis.t, dim=-1)[:, 2] > _UPRIGHT
    walks = (gone > SPEED_M_S[0]) & (gone < SPEED_M_S[1]) & upright
    if walks.sum() < LEAST_S * motion.fps:
        return None
    return (-head.R[walks, 2, 0]).clamp(-1, 1).asin().rad2deg().mean().item()


def _leg_m(skeleton: Skeleton) -> float:
    """Length (m) of thigh and shank, mean of both sides."""
    bones = skeleton.indices("left_knee", "left_ankle", "right_knee", "right_ankle")
    return skeleton.t_parent_joint[bones].norm(dim=-1).sum().item() / 2


def _uneven_m(skeleton: Skeleton) -> float:
    """Largest difference (m) of a bone on the left from that on the right."""
    left = [name for name in skeleton.joint_names if name.startswith("left_")]
    bones = skeleton.t_parent_joint.norm(dim=-1)
    other = [name.replace("left_", "right_") for name in left]
    return (bones[skeleton.indices(*left)] - bones[skeleton.indices(*other)]).abs().max().item()


def _eyes_m(recording: Recording, motion: Motion) -> float:
    """Height (m) of the head-mounted device in the rest pose, NaN without one."""
    seat = None if recording.head is None else recording.head.t_head_device[2].item()
    return _NAN if seat is None else motion.skeleton.height_of("head") + seat


def _rms(values: Float[Tensor, "point"]) -> float:
    return values.square().mean().sqrt().item()


def _median(values: Sequence[float]) -> float:
    return torch.tensor(values).nanmedian().item()


def _quantiles(values: Float[Tensor, "value"], *shares: float) -> list[float]:
    """Quantiles of values, NaN of none."""
    return values.quantile(torch.tensor(shares)).tolist() if len(values) else [_NAN] * len(shares)
