"""Frames of a motion on an even time grid, for formats with a fixed frame rate."""

import torch
from jaxtyping import Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.motion import Motion

STILL_FPS = 30.0
"""Rate (Hz) written for a motion of a single frame, which has none."""


def even_frames(motion: Motion) -> tuple[Int64[Tensor, "time"], float]:
    """Index of the nearest frame at each step of the motion's nominal rate, and that rate (Hz).

    An even motion keeps every frame once; over a gap the nearest frame is repeated, so that nothing shifts in time.
    Raises WearcapError for a motion without frames or with a gap of more than a minute.
    """
    if len(motion) == 0:
        raise WearcapError("the motion has no frames", expected="at least one frame to write")
    if len(motion) == 1:
        return torch.zeros(1, dtype=torch.int64), STILL_FPS
    steps, fps = motion.timestamps.diff(), nominal_fps(motion.fps)
    if not (steps > 0).all() or steps.max() > 60:
        raise WearcapError(
            "timestamps fall, repeat or leave a gap of over a minute",
            expected="rising timestamps in s",
            fix="Cut the motion at the gap.",
        )
    start, duration = motion.timestamps[0], motion.timestamps[-1] - motion.timestamps[0]
    grid = start + torch.arange(round(duration.item() * fps) + 1, dtype=torch.float64) / fps
    midpoints = (motion.timestamps[1:] + motion.timestamps[:-1]) / 2
    return torch.searchsorted(midpoints, grid), fps


def nominal_fps(fps: float) -> float:
    """Nearest integer rate if the rate was only rounded (120.0005 Hz from a step of .0083333 s), else the rate itself."""
    return float(round(fps)) if round(fps) and abs(fps - round(fps)) < 1e-4 * fps else fps
