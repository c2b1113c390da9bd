"""Resampling of motions, concatenation of consecutive pieces, and spans of a recording."""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.geometry.trajectory import Trajectory, interpolate, slerp
from wearcap.recording.motion import ESTIMATES, PER_FRAME, Interactions, Motion
from wearcap.recording.recording import Recording

_POSES = ("timestamps", "R_world_body", "t_world_body")


def resampled(motion: Motion, fps: float | int) -> Motion:
    """Resample a motion to `fps`: every n-th frame if the rates divide, else slerp (rotations) and lerp (root,
    contacts).

    Object trajectories keep their own timestamps.
    """
    ratio = motion.fps / fps
    steps = motion.timestamps.diff()
    even = steps.max() < 1.5 * steps.median()
    if even and abs(ratio - round(ratio)) < 0.01 and ratio > 0.5:
        n = round(ratio)
        return replace(
            motion,
            timestamps=motion.timestamps[::n].contiguous(),
            R_parent_joint=motion.R_parent_joint[::n],
            t_world_root=motion.t_world_root[::n],
            **_probabilities(motion, lambda prob: prob[::n]),
        )
    start, stop = motion.timestamps[0].item(), motion.timestamps[-1].item()
    times = start + torch.arange(int((stop - start) * fps + 1e-6) + 1, dtype=torch.float64) / fps
    return at_times(motion, times)


def at_times(motion: Motion, times: Float64[Tensor, "new_time"]) -> Motion:
    """Resample a motion at times within its span: slerp (rotations), lerp (root, contacts)."""
    return replace(
        motion,
        timestamps=times,
        R_parent_joint=slerp(motion.timestamps, motion.R_parent_joint, times),
        t_world_root=interpolate(motion.timestamps, motion.t_world_root, times),
        **_probabilities(motion, lambda prob: interpolate(motion.timestamps, prob, times)),
    )


def joined(parts: Sequence[Motion]) -> Motion | None:
    """Concatenate consecutive pieces of a motion; None for no piece. Skeleton and provenance are the first piece's.

    A field that some pieces lack is dropped, as it would have no rows for their frames.
    """
    if len(parts) < 2:
        return parts[0] if parts else None
    rows = {name: [getattr(part, name) for part in parts] for name in PER_FRAME}
    whole = {name: None if any(row is None for row in values) else torch.cat(values) for name, values in rows.items()}
    tracks: dict[str, list[Trajectory]] = {}
    for part in parts:
        for name, track in (part.object_motion or {}).items():
            tracks.setdefault(name, []).append(track)
    objects = {
        name: Trajectory(*(torch.cat([getattr(track, field) for track in each]) for field in _POSES))
        for name, each in tracks.items()
    }
    found = [part.interactions for part in parts if part.interactions is not None]
    interactions = Interactions.of(row for each in found for row in each.rows) if found else None
    return replace(parts[0], **whole, object_motion=objects or None, interactions=interactions)


def _probabilities(motion: Motion, change: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
    there = {name: getattr(motion, name) for name in ESTIMATES}
    return {name: change(prob) for name, prob in there.items() if prob is not None}


def first_seconds(recording: Recording, seconds: float) -> Recording:
    """The beginning of a recording: `seconds` of every stream (`between_seconds`)."""
    return between_seconds(recording, -math.inf, seconds)


def between_seconds(recording: Recording, start: float, stop: float) -> Recording:
    """A span of every stream of a recording, in seconds from the first pose of head or motion, `stop` excluded.

    Points, and intervals of an evaluation, stay as they are; interactions outside it are left out.
    """
    lead = recording.head or recording.suit or recording.motion
    if lead is None or not len(lead.timestamps):
        return recording
    start_s, stop_s = (lead.timestamps[0].item() + each for each in (start, stop))
    parts = {each.name: getattr(recording, each.name) for each in fields(recording)}
    cut = {name: _between(part, start_s, stop_s) for name, part in parts.items()}
    if recording.interactions is not None:
        rows = [(max(begin, start_s), min(end, stop_s), *rest) for begin, end, *rest in recording.interactions.rows]
        cut["interactions"] = Interactions.of(row for row in rows if row[0] < row[1])
    return replace(recording, **cut)


def _between(part: Any, start_s: float, stop_s: float) -> Any:
    """The frames of a stream, or of several by name, in a span; whatever has no timestamps stays as it is."""
    if isinstance(part, dict):
        return {name: _between(each, start_s, stop_s) for name, each in part.items()}
    times = getattr(part, "timestamps", None)
    if times is None or len(times) <= 3:  # three numbers may also be those of a mount
        return part
    start, stop = (int(torch.searchsorted(times, each)) for each in (start_s, stop_s))
    if isinstance(part, Motion):
        return part.sliced(start, stop)
    values = {each.name: getattr(part, each.name) for each in fields(part)}
    along = {name: value for name, value in values.items() if isinstance(value, Tensor | tuple)}
    return replace(part, **{name: value[start:stop] for name, value in along.items() if len(value) == len(times)})
