"""The floor beneath the wearer, from the best that a recording has."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.recording import Recording
from wearcap.scene.floor import EYE_HEIGHT_OF_STATURE, estimate_floor, floor_from_head

MIN_POINTS = 500
"""Fewer points than this say nothing about a floor."""


def floor_beneath(
    recording: Recording,
    timestamps: Float64[Tensor, "time"],
    t_world_head: Float[Tensor, "time 3"],
    stature: float,
) -> Float[Tensor, "time"]:
    """Floor height (m) under each head position: the recording's own track, else from its points and head path.

    `stature` is the head joint's height in the rest pose (m): without track and points, the head of someone who
    mostly stands tells where the floor is.
    """
    if recording.floor is not None:
        return interpolate(recording.floor.timestamps, recording.floor.height, timestamps)
    if recording.points is not None and len(recording.points.points_world) >= MIN_POINTS:
        return estimate_floor(recording.points.points_world, t_world_head, stature).height
    return floor_from_head(t_world_head, stature / EYE_HEIGHT_OF_STATURE).height


def interpolate(
    known: Float64[Tensor, "known"], value: Float[Tensor, "known"], wanted: Float64[Tensor, "time"]
) -> Float[Tensor, "time"]:
    """Linear interpolation in time, constant beyond the ends."""
    if len(known) == 1:
        return value.expand(len(wanted)).clone()
    right = torch.searchsorted(known, wanted).clamp(1, len(known) - 1)
    share = ((wanted - known[right - 1]) / (known[right] - known[right - 1])).clamp(0, 1).to(value.dtype)
    return value[right - 1] + share * (value[right] - value[right - 1])
