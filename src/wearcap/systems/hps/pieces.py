"""Pieces of a live recording: validation and concatenation."""

import math

import torch
from torch import Tensor

from wearcap.recording import Motion
from wearcap.recording.recording import Localization
from wearcap.sensors.packets import MAX_POSITION_M, MAX_TIME_S, OFF_THE_CLOCK, WRONG_TYPE, rotation_fault, values_fault

MAX_PAUSE_S = 10.0
"""Longest gap (s) within a stretch. A piece after a longer one is kept aside until the next piece continues it; then a
new stretch begins."""


def suit_fault(suit: object, like: Motion | None) -> str | None:
    """Reason to refuse a piece of a suit's motion, None for a good one; it must match an earlier good piece `like`."""
    if not isinstance(suit, Motion) or not isinstance(suit.timestamps, Tensor) or suit.timestamps.ndim != 1:
        return WRONG_TYPE
    times, count, joints = suit.timestamps, len(suit.timestamps), len(suit.skeleton)
    contact, before = suit.contact_prob, None if like is None else like.contact_prob
    fault = (
        _times_fault(times, MAX_PAUSE_S)
        or rotation_fault(suit.R_parent_joint, (count, joints, 3, 3))
        or values_fault(suit.t_world_root, (count, 3), MAX_POSITION_M)
        or (None if contact is None else _contact_fault(contact, count))
    )
    if fault is None and like is not None:
        same = like.skeleton.joint_names == suit.skeleton.joint_names and (contact is None) == (before is None)
        return (
            None
            if same and (before is None or contact is None or before.shape[1:] == contact.shape[1:])
            else WRONG_TYPE
        )
    return fault


def _contact_fault(contact: object, count: int) -> str | None:
    patches = contact.shape[-1:] if isinstance(contact, Tensor) else ()
    return values_fault(contact, (count, *patches), 1.0)


def localization_fault(seen: object, suit: Motion) -> str | None:
    """Reason to refuse a piece's camera poses, None for good ones; poses of confidence 0 are not checked."""
    if not isinstance(seen, Localization) or not isinstance(seen.timestamps, Tensor):
        return WRONG_TYPE
    count = seen.timestamps.numel()
    if fault := _times_fault(seen.timestamps, math.inf) or values_fault(seen.confidence, (count,), 1.0):
        return fault
    shapes = [getattr(part, "shape", None) for part in (seen.R_world_cam, seen.t_world_cam)]
    if shapes != [(count, 3, 3), (count, 3)]:
        return WRONG_TYPE
    found = seen.confidence > 0
    R, t = seen.R_world_cam[found], seen.t_world_cam[found]
    if seen.timestamps[-1] > suit.timestamps[-1] + MAX_PAUSE_S:
        return OFF_THE_CLOCK
    return rotation_fault(R, (len(R), 3, 3)) or values_fault(t, (len(R), 3), MAX_POSITION_M)


def _times_fault(times: Tensor, max_pause_s: float) -> str | None:
    if fault := values_fault(times, (times.numel(),), MAX_TIME_S):
        return fault
    steps = times.diff()
    return None if ((steps > 0) & (steps <= max_pause_s)).all() else OFF_THE_CLOCK


def follows(first: Motion, then: Motion) -> bool:
    """Whether a piece continues another, without overlap or a long gap."""
    return 0 < (then.timestamps[0] - first.timestamps[-1]).item() <= MAX_PAUSE_S


def more(first: Localization, then: Localization) -> Localization:
    """Concatenate two localisations."""
    names = ("timestamps", "R_world_cam", "t_world_cam", "confidence")
    return Localization(*(torch.cat([getattr(first, name), getattr(then, name)]) for name in names))


def cut(seen: Localization, first: int) -> Localization:
    """Drop the frames before `first`."""
    return Localization(
        seen.timestamps[first:], seen.R_world_cam[first:], seen.t_world_cam[first:], seen.confidence[first:]
    )
