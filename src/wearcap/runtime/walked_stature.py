"""The wearer's height with the captured motion: a leg that bears weight is nearly straight, so a body that is too tall walks
on bent knees, and one that is too small stretches them (ours)."""

from dataclasses import replace

import torch

from wearcap.body.skeleton import Skeleton, skeleton_of_height
from wearcap.metrics.gait import cycle_times, walking_scores
from wearcap.recording.timing import first_seconds
from wearcap.runtime.system import CaptureInput, System
from wearcap.tracking.stature import Stature

STANCE_DEG, STANCE_SPREAD_DEG = 11.0, 7.0
"""Flexion of people's knees in stance, and its deviation among people and captures of them."""
TRIED = (-1.6, -0.8, 0.0, 0.8, 1.6)
"""Heights that are tried, in deviations from the first estimate."""
LEAST_CYCLES = 2
"""Fewest walking cycles that a height follows from."""
LOOKED_S = 120.0
"""Beginning (s) of a recording whose walk is looked at."""


def with_walked_stature(
    system: System, source: CaptureInput, found: Stature, default: Skeleton
) -> tuple[CaptureInput, Stature]:
    """The recording with the height that its walk and the head's height together show, and that height.

    The system captures the beginning at each of the `TRIED` heights. Without points and a floor, with fewer than `LEAST_CYCLES`
    of walking, and for heights that are no estimate by the head's height, both are returned as they are.
    """
    recording = source.recording
    if found.source != "head" or (recording.points is None and recording.floor is None):
        return source, found
    beginning = first_seconds(recording, LOOKED_S)
    heights = [found.height_m + step * found.deviation_m for step in TRIED]
    tried = [replace(source, recording=replace(beginning, skeleton=skeleton_of_height(m, default))) for m in heights]
    motions = [each.motion for each in system.capture(tried, [0] * len(tried))]
    middle = motions[TRIED.index(0.0)]
    cycles = [] if middle is None else cycle_times(middle)
    if sum(map(len, cycles)) < LEAST_CYCLES or any(motion is None for motion in motions):
        return source, found
    knees = torch.tensor(
        [walking_scores(motion, cycles)["stance_knee_deg"] for motion in motions if motion is not None]
    )
    # The knee between the tried heights, and the density of each height given both.
    fine = torch.linspace(TRIED[0], TRIED[-1], 161)
    after = torch.searchsorted(torch.tensor(TRIED), fine).clamp(1, len(TRIED) - 1)
    low, high = (torch.tensor(TRIED)[after - 1 + k] for k in range(2))
    knee = torch.lerp(knees[after - 1], knees[after], (fine - low) / (high - low))
    density = torch.exp(-(fine.square() + ((knee - STANCE_DEG) / STANCE_SPREAD_DEG).square()) / 2)
    mean = (density * fine).sum() / density.sum()
    spread = ((density * (fine - mean).square()).sum() / density.sum()).sqrt()
    height_m = found.height_m + mean.item() * found.deviation_m
    walked = Stature(height_m, spread.item() * found.deviation_m, "walk")
    return replace(source, recording=replace(recording, skeleton=skeleton_of_height(height_m, default))), walked
