"""Figures that show whether recorded motion is that of a person: knees, soles, jumps, sides, proportions, the head's pitch."""

from collections.abc import Sequence
from math import isfinite, nan

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss, normalize

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.trajectory import interpolate_clamped, nearest_frames
from wearcap.metrics.gait import SPEED_M_S, STANCE, knee_cycles, knee_deg, normal_knee_deg, standing
from wearcap.metrics.physics import foot_contact, foot_points, foot_skate_cm_s
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording

LEAST_CYCLES, LEAST_S = 4, 1.0
"""Least cycles of walking, least time (s) of standing or of a recording's walking."""
ROOT_M_S, JOINT_M_S = 8.0, 15.0
"""Speeds that neither the pelvis nor any joint of a person reaches, as `prepare`'s limits have them."""


def truth(recordings: Sequence[Recording]) -> dict[str, float]:
    """Figures of one person by name with unit, from recordings with `motion`; those with nothing to measure are absent.

    Knees: deviation (rms) of the mean curve over the walking cycle from healthy adults', median in stance and standing,
    difference (rms) of the left curve from the right. Bones: largest difference of left from right. Leg (thigh and shank)
    and eyes (the device on the head, in the rest pose): shares of stature. Soles: percentiles of planted ones' heights.
    Pitch: median and deviation over recordings of the head's while walking, positive below the horizon.
    """
    pairs = [(recording, recording.motion) for recording in recordings if recording.motion is not None]
    motions = [motion for _, motion in pairs]
    minutes = sum((motion.timestamps[-1] - motion.timestamps[0]).item() for motion in motions) / 60
    bodies = torch.stack([_body(recording, motion) for recording, motion in pairs]).nanmedian(0).values
    heights, skates = zip(*(_soles(recording, motion) for recording, motion in pairs))
    soles = _quantiles(100 * torch.cat(heights), 0.05, 0.5, 0.95)
    skate, planted = torch.stack(skates).sum(0)
    pitches = torch.cat([_walking_pitch_deg(motion) for motion in motions])
    found = {
        "minutes": minutes,
        **_knees(motions, [not recording.activity or "walk" in recording.activity.lower() for recording, _ in pairs]),
        **dict(zip(("bones_cm", "stature_m", "leg", "eyes"), bodies.tolist())),
        **dict(zip(("sole_low_cm", "sole_cm", "sole_high_cm"), soles)),
        "skate_cm_s": (skate / planted).item(),
        "jumps_per_min": sum(_jumps(motion) for motion in motions) / minutes,
        "pitch_deg": _quantiles(pitches, 0.5)[0],
        "pitch_spread_deg": pitches.std().item() if len(pitches) > 1 else nan,
    }
    return {name: value for name, value in found.items() if isfinite(value)}


def _knees(motions: Sequence[Motion], walks: Sequence[bool]) -> dict[str, float]:
    """The figures of cycles, those of motions in which somebody may walk by their activity, and knees."""
    cycles = [[side[: len(side) * may] for side in knee_cycles(motion)] for motion, may in zip(motions, walks)]
    left, right = (torch.cat(side) for side in zip(*cycles))
    both, knees = torch.cat([left, right]), [knee_deg(motion) for motion in motions]
    stands = [standing(motion) for motion in motions]
    stood = torch.cat([knee[mask].flatten() for knee, mask in zip(knees, stands)])
    stood_s = sum(int(mask.sum()) / motion.fps for motion, mask in zip(motions, stands))
    known, sides = len(both) >= LEAST_CYCLES, min(len(left), len(right)) >= LEAST_CYCLES
    return {
        "cycles": len(both),
        "knee_rms_deg": mse_loss(both.mean(0), normal_knee_deg()).sqrt().item() if known else nan,
        "stance_deg": both[:, STANCE].mean(1).median().item() if known else nan,
        "standing_deg": stood.median().item() if stood_s >= LEAST_S else nan,
        "curves_deg": mse_loss(left.mean(0), right.mean(0)).sqrt().item() if sides else nan,
    }


def _body(recording: Recording, motion: Motion) -> Float[Tensor, "4"]:
    """Unevenness of the bones (cm), stature (m), and the shares in it of leg and eyes."""
    skeleton = motion.skeleton
    bones = dict(zip(skeleton.joint_names, skeleton.t_parent_joint.norm(dim=-1).tolist()))
    uneven = max(abs(bones[name] - bones.get(name.replace("left", "right"), bones[name])) for name in bones)
    leg = sum(bones[f"{side}_{joint}"] for side in ("left", "right") for joint in ("knee", "ankle")) / 2
    eyes = nan if recording.head is None else skeleton.height_of("head") + recording.head.t_head_device[2].item()
    return torch.tensor([100 * uneven, skeleton.stature, leg / skeleton.stature, eyes / skeleton.stature])


def _soles(recording: Recording, motion: Motion) -> tuple[Float[Tensor, "patch"], Float[Tensor, "2"]]:
    """Heights (m) over the floor of planted patches of the soles, where it is level for a second to either side; and
    skating (cm/s) times the number of steps in which a foot is planted, with that number."""
    times, track, floor, heights = motion.timestamps, recording.contacts, recording.floor, torch.zeros(0)
    feet = None if track is None else track.feet
    if track is None or feet is None or not len(feet) or not set(FOOT_PATCHES) <= set(motion.skeleton.sites):
        return heights, torch.zeros(2)
    contact = feet[nearest_frames(track.timestamps, times)]
    planted = foot_contact(contact)
    skate = foot_skate_cm_s(foot_points(motion.skeleton, motion.T_world_joint), planted, motion.fps).nan_to_num()
    count = (planted[1:] & planted[:-1]).sum()
    if floor is not None and len(floor.height):
        around = interpolate_clamped(floor.timestamps, floor.height, times + torch.tensor([[-1.0], [0.0], [1.0]]))
        level = around.amax(0) - around.amin(0) < 0.01
        patches = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)[..., 2]
        heights = (patches - around[1][:, None])[contact & level[:, None]]
    return heights, torch.stack([skate * count, count])


def _jumps(motion: Motion) -> int:
    """Number of steps in which the root or a joint moves faster than any person's."""
    speed = motion.T_world_joint.t.diff(dim=0).norm(dim=-1) / motion.timestamps.diff().to(motion.t_world_root)[:, None]
    return int(((speed[:, 0] > ROOT_M_S) | (speed > JOINT_M_S).any(1)).sum())


def _walking_pitch_deg(motion: Motion) -> Float[Tensor, "known"]:
    """Mean pitch (degrees below the horizon) of the head while it walks upright; none where it hardly does."""
    span = round(motion.fps)
    gone = (motion.t_world_root[span:] - motion.t_world_root[:-span])[:, :2].norm(dim=-1)
    head, pelvis = (motion.joint(name)[span // 2 : span // 2 + len(gone)] for name in ("head", "pelvis"))
    upright = normalize(head.t - pelvis.t, dim=-1)[:, 2] > 0.9
    walks = (gone > SPEED_M_S[0]) & (gone < SPEED_M_S[1]) & upright
    pitch = (-head.R[walks, 2, 0]).clamp(-1, 1).asin().rad2deg().mean()
    return pitch[None][: int(walks.sum() >= LEAST_S * motion.fps)]


def _quantiles(values: Float[Tensor, "value"], *shares: float) -> list[float]:
    return values.quantile(torch.tensor(shares)).tolist() if len(values) else [nan] * len(shares)
