"""Watches that reach us later or sooner than the head does, found by a turn on the spot.

The quickest packets show how two clocks stand only up to the time that every packet takes, and from a watch by way of its
phone that may be seconds. A wearer who turns to and fro carries head and watches along: the angular speeds about the
vertical, which need neither headings nor seats, are alike at one offset of the clocks.

People turn their head before the body, so that a good clock, too, seems to be off. `python -m benchmarks.faults.live_turns`
measures this on CMU recordings, in windows of 10 s in which head and wrist turn enough to both sides. Of people who turn at
one place with hanging arms, 38 of 60 windows, of 6 recordings, reach a correlation of `LEAST_LIKENESS`: in them watches seem
late by 0.08 s (median; 5th and 95th percentile 0 and 0.12 s, at most 0.14 s). Where they also walk or use their hands, it is
at most 0.36 s; simulated wearers lead with the head by 0.3 s. Nobody in them was asked to turn. Offsets up to
`LEAST_OFFSET_S` may thus be none, and are left alone; larger ones are made up for, and that tenth of a second is what is
left of them.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.signal
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.correlation import best_shift
from wearcap.geometry.trajectory import Trajectory

RATE_HZ = 100.0
SMOOTH_S = 0.15
"""Deviation (s) of the mean over which turning is compared: arms swing faster than a body turns."""
LEAST_LIKENESS = 0.8
"""Least correlation of the turning of head and wrist."""
STILL_RAD_S = 0.3
"""Turning (rad/s) up to which someone rests; it does not count."""
MAX_OFFSET_S = 5.0
"""Largest offset that is looked for."""
LEAST_OFFSET_S = 0.4
"""Offset up to which a clock is left alone: more than turns of a head before the body make."""
ENOUGH_RAD = math.radians(120)
"""Turning to the left, and to the right, that is enough: 60° each way, twice. With less than half of it nothing is compared."""
REST_S = 0.7
"""Time (s) of rest after which a turn is over."""
MAX_STEPS = 1_000_000
"""Most steps of a comparison, whatever the times say."""
WHERE = "clocks of head and watch"
FIX = "Turn head and body together, to one side and back, twice, arms hanging."


class Aligned(NamedTuple):
    """What a turn showed of a watch's clock."""

    device: str
    offset_s: float
    """Seconds to add to the watch's times; 0: its clock is left as it is."""
    note: str
    """What was found, or why nothing was, as a sentence."""


def aligned_by_turning(
    head: Trajectory | None, watch: Trajectory | None, device: str, name: str
) -> tuple[Aligned, bool]:
    """A watch's offset from the head's clock beyond `LEAST_OFFSET_S`, and whether the turn shows how the clocks stand.

    `name` begins the note; a trajectory is None where a device sends nothing. Raises nothing for what devices sent.
    """
    try:
        if head is None or watch is None:
            raise WearcapError(f"the {'head' if head is None else 'watch'} sends nothing")
        offset_s = offset_by_turning(head, watch, MAX_OFFSET_S)
    except WearcapError as error:
        note = f"{name}: its clock counts as its quickest packets show, since {error.what}."
        return Aligned(device, 0.0, note), False
    if abs(offset_s) <= LEAST_OFFSET_S:
        note = f"{name}: the turn shows no offset of its clock above {LEAST_OFFSET_S:g} s; it is left as it is."
        return Aligned(device, 0.0, note), True
    when = "late" if offset_s < 0 else "early"
    note = f"{name}: its samples come {abs(offset_s):.2f} s {when} beside the head's, by the turn; this is made up for."
    return Aligned(device, offset_s, note), True


def offset_by_turning(head: Trajectory, watch: Trajectory, max_offset_s: float = MAX_OFFSET_S) -> float:
    """Seconds to add to a watch's times to bring them to the head's clock, by turns of the whole body.

    Both stand still before the first of their poses and after the last. Raises WearcapError where one of both hardly turns,
    and where they turn alike at no offset.
    """
    (head_s, of_head), (watch_s, of_watch) = _turning(head), _turning(watch)
    for name, rate in (("head", of_head), ("watch", of_watch)):
        if _share(rate) < 0.5:
            raise WearcapError(f"the {name} hardly turns", WHERE, fix=FIX)
    # Beyond the ends there is no turning: a whole turn counts at every offset, so that the next turn does not stand for it.
    score = scipy.signal.correlate(of_head, of_watch) / (np.linalg.norm(of_head) * np.linalg.norm(of_watch))
    shifts = np.arange(1 - len(of_watch), len(of_head))
    allowed = np.abs(head_s - watch_s + shifts / RATE_HZ) <= max_offset_s
    shift, best = best_shift(shifts[allowed], score[allowed]) if allowed.any() else (0.0, 0.0)
    if best < LEAST_LIKENESS:
        what = (
            f"head and watch turn alike at no offset of their clocks up to {max_offset_s:g} s (correlation {best:.2f})"
        )
        raise WearcapError(what, WHERE, f"{LEAST_LIKENESS} or more", FIX)
    return float(head_s - watch_s + shift / RATE_HZ)


def turned(tracks: Mapping[str, Trajectory | None]) -> tuple[float, str]:
    """Share of `ENOUGH_RAD` that all have turned to both sides, below 1 until they rest again; why it does not go on.

    Keys are names that begin a sentence; None: the device sends nothing.
    """
    shares, moving = {}, []
    for name, track in tracks.items():
        try:
            rate = np.zeros(1) if track is None else _turning(track)[1]
        except WearcapError:
            rate = np.zeros(1)
        shares[name] = _share(rate)
        if np.abs(rate[-round(REST_S * RATE_HZ) :]).max() > STILL_RAD_S:
            moving.append(name)
    least = min(shares, key=lambda name: shares[name])
    if tracks[least] is None:
        return 0.0, f"{least} sends nothing."
    if shares[least] < 1.0:
        most = max(shares.values())
        return shares[least], f"{least} has not turned as far." if most >= 1.0 and not moving else ""
    return (0.99, "Stand still again.") if moving else (1.0, "")


def _share(rate: Float64[np.ndarray, "step"]) -> float:
    """Share of `ENOUGH_RAD` that has been turned to the left and to the right."""
    rate = np.where(np.abs(rate) > STILL_RAD_S, rate, 0.0)
    return float(min(rate.clip(min=0).sum(), -rate.clip(max=0).sum())) / RATE_HZ / ENOUGH_RAD


def _turning(track: Trajectory) -> tuple[float, Float64[np.ndarray, "step"]]:
    """Time (s) of the first value, and smoothed angular speeds (rad/s) about the vertical at `RATE_HZ`."""
    times = track.timestamps
    span = (times[-1] - times[0]).item() if len(times) > 1 else 0.0
    if not 2.0 <= span <= MAX_STEPS / RATE_HZ:
        raise WearcapError(f"{span:.1f} s of a device", WHERE, "2 s or more")
    angle = np.concatenate([[0.0], vertical_rate(track.R_world_body).cumsum(0).numpy()])
    grid = times[0].item() + np.arange(int(span * RATE_HZ)) / RATE_HZ
    rate = np.diff(np.interp(grid, times.numpy(), angle)) * RATE_HZ
    smooth = scipy.ndimage.gaussian_filter1d(rate, SMOOTH_S * RATE_HZ, mode="nearest")
    return grid[0] + 0.5 / RATE_HZ, smooth


def vertical_rate(R_world_body: Float[Tensor, "time 3 3"]) -> Float64[Tensor, "step"]:
    """Turn (rad) about the world's vertical from each frame to the next."""
    R = R_world_body.double()
    return rotation.log(R[1:] @ R[:-1].mT)[:, 2]
