"""Offsets between devices whose clocks differ by more than the network's delay: by a clap, and by turning on the spot.

Claps are sharp and align two watches within a sample; the head does not feel them. A wearer who turns carries head and
watches along, which aligns a watch with the head.
"""

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.devices.head_alignment import best_shift, correlate_shifts
from wearcap.recording.recording import ImuStream
from wearcap.sensors.claps import detect_claps
from wearcap.sensors.clock import fit_clock

RATE_HZ = 100.0
SMOOTH_S = 0.15
"""Deviation (s) of the mean over which turning is compared: arms swing faster than a body turns."""
LEAST_LIKENESS = 0.6
"""Least correlation of the turning of head and wrist."""
LEAST_TURN_RAD_S = 0.5
"""Least turning that both must show."""
MAX_STEPS = 1_000_000
"""Most steps of a comparison, whatever the times say."""


def offset_by_claps(first: ImuStream, second: ImuStream, max_offset_s: float = 600.0) -> float:
    """Seconds to add to the second watch's times to bring them to the first one's clock, by claps that both felt.

    Raises WearcapError where one felt no clap, and where two offsets fit equally well.
    """
    return fit_clock(detect_claps(first), detect_claps(second), max_offset_s).offset_s


def offset_by_turning(head: Trajectory, watch: Trajectory, max_offset_s: float = 60.0) -> float:
    """Seconds to add to a watch's times to bring them to the head's clock, by turns of the whole body.

    Compared is the angular speed about the vertical, which needs neither headings nor seats. Raises WearcapError where
    one of both hardly turns, and where they turn alike at no offset.
    """
    (head_s, of_head), (watch_s, of_watch) = _turning(head), _turning(watch)
    for name, rate in (("head", of_head), ("watch", of_watch)):
        if np.abs(rate).max() < LEAST_TURN_RAD_S:
            fix = "Turn on the spot to one side and back, twice, arms hanging."
            raise WearcapError(f"the {name} hardly turns", "clocks of head and watch", fix=fix)
    shifts, score = correlate_shifts(of_watch, of_head, 1 / 3)
    allowed = np.abs(head_s - watch_s + shifts / RATE_HZ) <= max_offset_s
    if not allowed.any() or score[allowed].max() < LEAST_LIKENESS:
        best = score[allowed].max() if allowed.any() else 0.0
        what = (
            f"head and watch turn alike at no offset of their clocks up to {max_offset_s:g} s (correlation {best:.2f})"
        )
        fix = "Turn on the spot to one side and back, twice, arms hanging."
        raise WearcapError(what, "clocks of head and watch", f"{LEAST_LIKENESS} or more", fix)
    shift, _ = best_shift(shifts[allowed], score[allowed])
    return head_s - watch_s + shift / RATE_HZ


def _turning(track: Trajectory) -> tuple[float, np.ndarray]:
    """Time (s) of the first value, and smoothed angular speeds (rad/s) about the vertical at `RATE_HZ`."""
    times = track.timestamps
    span = (times[-1] - times[0]).item() if len(times) > 1 else 0.0
    if not 2.0 <= span <= MAX_STEPS / RATE_HZ:
        raise WearcapError(f"{span:.1f} s of a device", "clocks of head and watch", "2 s or more")
    grid = times[0] + torch.arange(int(span * RATE_HZ), dtype=torch.float64) / RATE_HZ
    rate = vertical_rate(resample(track, grid).R_world_body.double()) * RATE_HZ
    smooth = scipy.ndimage.gaussian_filter1d(rate.numpy(), SMOOTH_S * RATE_HZ, mode="nearest")
    return grid[0].item() + 0.5 / RATE_HZ, smooth


def vertical_rate(R_world_body: Float[Tensor, "time 3 3"]) -> Float64[Tensor, "step"]:
    """Turn (rad) about the world's vertical from each frame to the next."""
    R = R_world_body.double()
    return rotation.log(R[1:] @ R[:-1].mT)[:, 2]
