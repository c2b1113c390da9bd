"""Resampling of motions, and concatenation of consecutive pieces."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, interpolate
from wearcap.recording.interactions import Interactions
from wearcap.recording.motion import Motion

PROBABILITIES = ("contact_prob", "hand_contact_prob", "body_contact_prob")
"""Optional fields of a Motion with a row per frame."""


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
        R_parent_joint=_slerp(motion.timestamps, motion.R_parent_joint, times),
        t_world_root=interpolate(motion.timestamps, motion.t_world_root, times),
        **_probabilities(motion, lambda prob: interpolate(motion.timestamps, prob, times)),
    )


def joined(parts: Sequence[Motion]) -> Motion | None:
    """Concatenate consecutive pieces of a motion; None for no piece. Skeleton and provenance are the first piece's.

    A field that some pieces lack is dropped, as it would have no rows for their frames.
    """
    if len(parts) < 2:
        return parts[0] if parts else None
    fields = ("timestamps", "R_parent_joint", "t_world_root", *PROBABILITIES)
    rows = {name: [getattr(part, name) for part in parts] for name in fields}
    whole = {name: None if any(row is None for row in values) else torch.cat(values) for name, values in rows.items()}
    tracks: dict[str, list[Trajectory]] = {}
    for part in parts:
        for name, track in (part.object_motion or {}).items():
            tracks.setdefault(name, []).append(track)
    objects = {name: _end_to_end(each) for name, each in tracks.items()} or None
    found = [part.interactions for part in parts if part.interactions is not None]
    return replace(parts[0], **whole, object_motion=objects, interactions=_all_of(found) if found else None)


def _end_to_end(tracks: list[Trajectory]) -> Trajectory:
    times, R, t = zip(*((each.timestamps, each.R_world_body, each.t_world_body) for each in tracks))
    return Trajectory(torch.cat(times), torch.cat(R), torch.cat(t))


def _all_of(parts: list[Interactions]) -> Interactions:
    start, stop, hands = (torch.cat([getattr(each, name) for each in parts]) for name in ("start_s", "stop_s", "hands"))
    objects, classes = (tuple(name for each in parts for name in getattr(each, key)) for key in ("objects", "classes"))
    return Interactions(start, stop, hands, objects, classes)


def _probabilities(motion: Motion, change: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
    there = {name: getattr(motion, name) for name in PROBABILITIES}
    return {name: change(prob) for name, prob in there.items() if prob is not None}


def _slerp(
    timestamps: Float64[Tensor, "time"], R: Float[Tensor, "time joint 3 3"], at: Float64[Tensor, "new_time"]
) -> Float[Tensor, "new_time joint 3 3"]:
    after = torch.searchsorted(timestamps, at, right=True).clamp(1, len(timestamps) - 1)
    before = after - 1
    blend = ((at - timestamps[before]) / (timestamps[after] - timestamps[before])).clamp(0, 1).to(R.dtype)
    turn = rotation.log(R[before].mT @ R[after])
    return R[before] @ rotation.exp(blend[:, None, None] * turn)
