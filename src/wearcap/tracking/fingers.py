"""Fingers of a motion from tracked hands: their angles, fitted frame by frame, and what stands in where nothing was measured.

The palm (wrist and four knuckles) is rigid, and gives the hand's axes by Procrustes' method. In these a finger's bones are
directions, which its five angles explain by least squares within their limits (`body.hands`): a Gauss–Newton method with
active bounds, over all frames and fingers at once. Bones keep the device's own lengths, each the median over time.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from wearcap.body.hands import (
    CHAINS,
    LIMITS,
    PALM,
    REST,
    TIP_SHARE,
    HandShape,
    default_shape,
    finger_axes,
    has_fingers,
    scaled_shape,
    with_finger_joints,
    with_finger_rotations,
)
from wearcap.body.skeleton import MIRROR, SIDES, Skeleton
from wearcap.geometry.rotation import about_axis, nearest_rotation
from wearcap.recording import FingerStream, Motion

MIN_CONFIDENCE = 0.5
FADE_S, HOLD_S = 0.2, 0.05
"""Time in which a hand that is lost relaxes, after keeping its last pose for so long: a quarter of a second in all."""
SHORT_S = 2 * (FADE_S + HOLD_S)
"""Longest gap (s) that is interpolated."""
PALM_M = (0.03, 0.18)
"""Distance of wrist and middle knuckle in hands of infants and giants; an adult's is 0.09 m."""
LEAST_AREA_M2 = 2e-4
"""Area of the triangle of wrist, index and little knuckle below which a palm has no axes; an adult's is 2.5e-3."""
LEAST_BONE_M = 0.004
WORST_RAD = 0.45
"""Root mean square angle between bones and fit from which on the points are no hand: mirrored, swapped or lost."""
MIN_BONES = 9
"""Least number of bones, of 15, that say something of a hand."""
BENDS = torch.tensor([0.0, 1.0, 0.0, 1.0, 1.0], dtype=torch.float64)
"""Of a finger's angles its flexions: the fit starts from the relaxed, the half or the wholly curled finger, whichever is nearest."""
_STEPS, _STEP_RAD, _PRIOR = 15, 0.5, 1e-3
"""Gauss–Newton steps, the longest of an angle, and the weight of the rest pose beside bones of weight 1: it decides what these
leave open."""
_CHUNK = 1 << 15
"""Frames that are fitted at once, which bounds memory."""


class FittedHand(NamedTuple):
    """A hand's finger angles over time."""

    timestamps: Float64[Tensor, "time"]
    angles: Float64[Tensor, "time finger 5"]
    """In the order of `body.hands.LIMITS`, and within them in every frame."""
    measured: Bool[Tensor, "time"]
    """Frames in which the hand was tracked and its points are those of a hand; the others' angles mean nothing."""
    shape: HandShape | None
    """The hand's bones; None where no frame was measured."""
    wrong: float
    """Share of the tracked frames whose points are no such hand."""


def fit_hand(stream: FingerStream, side: str) -> FittedHand:
    """Finger angles of a tracked hand. Hands of the other side, and points that are none, are not measured."""
    points, tracked = _left_points(stream, side), stream.valid & (stream.confidence >= MIN_CONFIDENCE)
    index, little = points[:, PALM[1]] - points[:, 0], points[:, PALM[4]] - points[:, 0]
    length = (points[:, PALM[2]] - points[:, 0]).norm(dim=-1)
    whole = (length > PALM_M[0]) & (length < PALM_M[1])  # NaN is neither
    whole &= torch.linalg.cross(index, little).norm(dim=-1) / 2 > LEAST_AREA_M2
    whole &= points[:, PALM, :].isfinite().all(-1).all(-1) & tracked
    angles, measured, shape = REST.repeat(len(points), 1, 1), torch.zeros_like(whole), None
    if whole.any():
        hand = _in_hand_axes(points[whole])
        shape = _shape(hand)
        fitted, error = zip(*(_fit(part, shape) for part in hand.split(_CHUNK)))
        angles[whole], measured[whole] = torch.cat(fitted), torch.cat(error) < WORST_RAD
        shape = _shape(hand[measured[whole]]) if measured.any() else None
    wrong = int((tracked & ~measured).sum()) / max(1, int(tracked.sum()))
    return FittedHand(stream.timestamps, angles, measured, shape, wrong)


def _left_points(stream: FingerStream, side: str) -> Float64[Tensor, "time joint 3"]:
    """Places as of a left hand; tips that the device lacks follow from the last joints' rotations."""
    points = stream.points.double().clone()
    if stream.rotations is not None:
        along = stream.rotations.double()[..., 1] * (1.0 if side == "left" else -1.0)
        for _, second, third, tip in CHAINS:
            length = TIP_SHARE * (points[:, third] - points[:, second]).norm(dim=-1, keepdim=True)
            made = points[:, third] + length * along[:, third]
            points[:, tip] = torch.where(points[:, tip].isfinite(), points[:, tip], made)
    return points if side == "left" else points * points.new_tensor(MIRROR)


def _in_hand_axes(points: Float64[Tensor, "time joint 3"]) -> Float64[Tensor, "time joint 3"]:
    """Places from the wrist in the axes in which the palm lies most like the default hand's."""
    default = default_shape()
    palm = torch.cat([default.knuckles.new_zeros(1, 3), default.knuckles[1:]])
    seen = points[:, PALM, :]
    R = nearest_rotation((seen - seen.mean(1, keepdim=True)).mT @ (palm - palm.mean(0)))
    return (points - points[:, :1]) @ R


def _shape(hand: Float64[Tensor, "time joint 3"]) -> HandShape:
    """Medians over time of knuckles and lengths of bones; what the device lacks is the default hand's at the palm's size."""
    knuckles, default = hand[:, [chain[0] for chain in CHAINS]].nanmedian(0).values, default_shape()
    default = default.scaled((knuckles[1:].norm(dim=-1).mean() / default.knuckles[1:].norm(dim=-1).mean()).item())
    knuckles = knuckles.where(knuckles.isfinite(), default.knuckles)
    lengths = _bones(hand, knuckles).norm(dim=-1).nanmedian(0).values
    return HandShape(knuckles, lengths.where((lengths > LEAST_BONE_M) & lengths.isfinite(), default.bones))


def _bones(
    hand: Float64[Tensor, "time joint 3"], knuckles: Float64[Tensor, "finger 3"]
) -> Float64[Tensor, "time finger bone 3"]:
    """The bones as vectors (m), the first ones from where the rigid palm has the knuckles."""
    ends = hand[:, torch.tensor(CHAINS)].clone()
    ends[:, :, 0] = knuckles
    return ends.diff(dim=2)


def _fit(
    hand: Float64[Tensor, "time joint 3"], shape: HandShape
) -> tuple[Float64[Tensor, "time finger 5"], Float64[Tensor, "time"]]:
    """Angles, and the root mean square angle (rad) between the bones and theirs."""
    bones = _bones(hand, shape.knuckles)
    weight = ((bones.norm(dim=-1) > LEAST_BONE_M) & bones.isfinite().all(-1)).double()
    seen = torch.nn.functional.normalize(bones.nan_to_num(0.0), dim=-1) @ finger_axes()
    low, high = LIMITS.unbind(-1)
    starts = torch.stack([REST + curl * BENDS * (high - REST) for curl in (0.0, 0.4, 0.8)])
    far = (weight[:, None, ..., None] * (seen[:, None] - _directions(starts)[0])).square().sum((-1, -2))
    nearest = far.argmin(1)[..., None].expand(-1, -1, 5)
    angles = starts.expand(len(hand), -1, -1, -1).gather(1, nearest[:, None])[:, 0]
    prior = _PRIOR * torch.eye(5, dtype=torch.float64)
    for _ in range(_STEPS):
        directions, J = _directions(angles)
        error = (weight[..., None] * (seen - directions)).flatten(-2)
        J = (weight[..., None, None] * J).flatten(-3, -2)
        gradient = (J.mT @ error[..., None])[..., 0] + _PRIOR * (REST - angles)
        held = ((angles <= low) & (gradient < 0)) | ((angles >= high) & (gradient > 0))
        free = (~held).double()
        square = J.mT @ J * free[..., None] * free[..., None, :] + prior
        step = torch.linalg.solve(square, gradient * free)
        before, angles = angles, (angles + step.clamp(-_STEP_RAD, _STEP_RAD)).clamp(low, high)
        if (angles - before).abs().max() < _STEP_RAD * 1e-5:
            break
    chord = (seen - _directions(angles)[0]).norm(dim=-1)
    total = weight.sum((-1, -2))
    error = ((weight * (2 * (chord / 2).clamp(max=1).asin()).square()).sum((-1, -2)) / total.clamp_min(1)).sqrt()
    return angles, torch.where(total >= MIN_BONES, error, torch.inf)


def _directions(
    angles: Float64[Tensor, "time finger 5"],
) -> tuple[Float64[Tensor, "time finger bone 3"], Float64[Tensor, "time finger bone 3 5"]]:
    """Directions of a finger's three bones in its axes, and their derivatives: an angle's axis times the direction."""
    abduction, first, twist, second, third = angles.unbind(-1)
    Rz = about_axis("z", -abduction)
    base = Rz @ about_axis("x", -first)
    knuckle = base @ about_axis("y", twist)
    ends = [base, knuckle @ about_axis("x", -second), knuckle @ about_axis("x", -second - third)]
    directions = torch.stack([end[..., 1] for end in ends], -2)
    up, bend = torch.zeros_like(Rz[..., 0]), -knuckle[..., 0]
    up[..., 2] = -1.0
    axes = torch.stack([up, -Rz[..., 0], base[..., 1], bend, bend], -2)
    J = torch.linalg.cross(axes[..., None, :, :], directions[..., None, :]).mT
    J[..., 0, :, 3:] = 0.0  # the first bone comes before PIP and DIP, the second before DIP
    J[..., 1, :, 4] = 0.0
    return directions, J


def bridged(
    hand: FittedHand, at: Float64[Tensor, "frame"]
) -> tuple[Float64[Tensor, "frame finger 5"], Float64[Tensor, "frame"]]:
    """Angles at any times, and 1 where they are measured.

    Between two measured frames angles are interpolated. Where they are further apart than usual the frames between are not
    measured, and beyond `SHORT_S` the hand relaxes after the one and reaches for the other.
    """
    times, angles = hand.timestamps[hand.measured], hand.angles[hand.measured]
    if not len(times):
        return REST.repeat(len(at), 1, 1), torch.zeros(len(at), dtype=torch.float64)
    step = hand.timestamps.diff().median().item() if len(hand.timestamps) > 1 else 0.0
    after = torch.searchsorted(times, at.contiguous())
    before, exists = (after - 1).clamp_min(0), (after > 0, after < len(times))
    after = after.clamp(max=len(times) - 1)
    since = (at - times[before]).where(exists[0], torch.inf)
    until = (times[after] - at).where(exists[1], torch.inf)
    keeps = [1 - ((gap - HOLD_S) / FADE_S).clamp(0, 1) for gap in (since, until)]
    short = (since + until) <= SHORT_S
    share = (since / (since + until).clamp_min(1e-9)).where(short, 0.0)
    w_before, w_after = (w * w * (3 - 2 * w) for w in keeps)  # a smooth step
    w_before, w_after = (1 - share).where(short, w_before), share.where(short, w_after)
    mixed = w_before[:, None, None] * (angles[before] - REST) + w_after[:, None, None] * (angles[after] - REST)
    near = torch.minimum(since, until) <= 1e-4
    return REST + mixed, (near | ((since + until) <= 1.5 * step)).double()


def with_fingers(motion: Motion, fingers: Mapping[str, FingerStream]) -> Motion:
    """A motion with the fingers of its wearer's tracked hands, at its own times; without any, the motion as it is.

    The skeleton gets SMPL+H's finger joints: of the device's bones, or of its other hand's, or scaled to the body. Fingers
    that are not tracked rest, and `fingers_measured` says which are. A skeleton with fingers stays as it is.
    """
    if not fingers or has_fingers(motion.skeleton) or not len(motion):
        return motion
    hands = {side: fit_hand(stream, side) for side, stream in fingers.items()}
    return posed(motion, fingered(motion.skeleton, hands), hands)


def fingered(skeleton: Skeleton, hands: Mapping[str, FittedHand]) -> Skeleton:
    """The skeleton with fingers of the hands' bones, else of the other hand's, else scaled to the body."""
    known = {side: hand.shape for side, hand in hands.items() if hand.shape is not None}
    spare = next(iter(known.values()), None) or scaled_shape(skeleton)
    return with_finger_joints(skeleton, {side: known.get(side, spare) for side in SIDES})


def posed(motion: Motion, skeleton: Skeleton, hands: Mapping[str, FittedHand]) -> Motion:
    """A motion on its skeleton with fingers (`fingered`), which pose as the hands do."""
    rest = REST.repeat(len(motion), 1, 1), torch.zeros(len(motion), dtype=torch.float64)
    found = {side: bridged(hands[side], motion.timestamps) if side in hands else rest for side in SIDES}
    angles, measured = ({side: each[k] for side, each in found.items()} for k in (0, 1))
    std = motion.joint_std
    if std is not None:  # unknown, but no less than their wrist's
        wrists = [motion.skeleton.index(f"{side}_wrist") for side in SIDES]
        std = torch.cat([std, std[:, wrists].repeat_interleave((len(skeleton) - std.shape[1]) // 2, 1)], 1)
    return replace(
        motion,
        skeleton=skeleton,
        R_parent_joint=with_finger_rotations(motion.R_parent_joint, motion.skeleton, angles),
        fingers_measured=torch.stack([measured[side] for side in SIDES], -1).float(),
        joint_std=std,
    )
