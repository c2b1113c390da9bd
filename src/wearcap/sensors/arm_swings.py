"""Clock synchronisation by arm swings: times of the highest forearm against times of the hands nearest to the camera.

MocapEvery, appendix C.2: swings are more reliable than claps, whose impact may disturb a wrist sensor.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import scipy.signal
import torch
from jaxtyping import Float, Float64
from scipy.special import ndtr
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.recording import ImuStream
from wearcap.sensors.clock import TOLERANCE_S, Clock, fit_clock
from wearcap.sensors.stillness import StepCheck, Stretch

_STEP_S = 0.01
"""Time step of the resampled elevations (100 Hz)."""
_TREMOR_S = 0.03
"""Standard deviation of the Gaussian that smooths the elevations."""
_TOP_S = 0.1
"""Half width of the parabola fit around a peak."""
_PEAK_S = 0.002
"""Standard deviation of a watch's peak time (simulated watches: below 1 ms), with a margin for uneven swings."""


@dataclass(frozen=True)
class SwingSettings:
    """Thresholds for a peak of the forearm's elevation to count as a swing."""

    min_rise_deg: float = 50.0
    """Prominence of the peak."""
    min_height_deg: float = -10.0
    min_apart_s: float = 0.5


@dataclass(frozen=True)
class SwingClock:
    """Clock estimated from swings, and the standard deviation (s) of its offset at the swings."""

    clock: Clock
    std_s: float


def forearm_elevation(stream: ImuStream) -> Float[Tensor, "time"]:
    """Angle (rad) of the forearm, elbow to hand, above the horizontal.

    Where the mounting is unknown the forearm is the watch's x axis, with the sign that lets the hand hang most of the
    time. Only the direction of gravity counts, so that any reference frame with z up will do.
    """
    if stream.R_world_imu is None:
        raise WearcapError("a stream without orientation", where=stream.joint, expected="a watch's attitude")
    up_imu = stream.R_world_imu[:, 2]
    if stream.R_joint_imu is not None:
        side = -1.0 if stream.joint.startswith("right") else 1.0
        sine = side * up_imu @ stream.R_joint_imu[1].to(up_imu)
    else:
        sine = up_imu[:, 0]
        sine = sine if sine.median() <= 0 else -sine
    return sine.clamp(-1, 1).asin()


def swing_peaks(
    stream: ImuStream, stretch: Stretch | None = None, settings: SwingSettings = SwingSettings()
) -> Float64[Tensor, "swing"]:
    """Times (s, the stream's clock) at which the forearm is highest, finer than samples: the top of a parabola.

    Raises WearcapError when there is none in the stretch (whole log by default).
    """
    times = stream.timestamps.numpy()
    start, stop = stretch or (times[0], times[-1])
    grid = np.arange(max(start, times[0]), min(stop, times[-1]), _STEP_S)
    none = WearcapError(
        f"no arm swing from {start:.1f} s to {stop:.1f} s",
        where=stream.joint,
        expected=f"a forearm that rises by {settings.min_rise_deg:g}° and falls again",
        fix="Swing the stretched arms from hanging to above the shoulders, ten times.",
    )
    if len(grid) < 2 * _TOP_S / _STEP_S + 3:
        raise none
    elevation = np.rad2deg(np.interp(grid, times, forearm_elevation(stream).double().numpy()))
    smooth = scipy.ndimage.gaussian_filter1d(elevation, _TREMOR_S / _STEP_S)
    tops, _ = scipy.signal.find_peaks(
        smooth,
        height=settings.min_height_deg,
        prominence=settings.min_rise_deg,
        distance=max(round(settings.min_apart_s / _STEP_S), 1),
    )
    reach = round(_TOP_S / _STEP_S)
    tops = tops[(tops >= reach) & (tops < len(smooth) - reach)]
    if not len(tops):
        raise none
    shift = np.arange(-reach, reach + 1)
    quadratic, linear, _ = np.polyfit(shift, smooth[tops[:, None] + shift].T, 2)
    finer = np.clip(-linear / (2 * np.minimum(quadratic, -1e-9)), -reach, reach)
    return torch.from_numpy(grid[0] + (tops + finer) * _STEP_S)


def fit_swing_clock(
    camera_s: Float64[Tensor, "swing_camera"],
    watch_s: Float64[Tensor, "swing_watch"],
    frame_s: float,
    max_offset_s: float = 600.0,
) -> SwingClock:
    """Fit the clock that maps the watch's swings to the camera's, whose times are accurate to half a frame.

    `fit_clock` finds the correspondences and the drift. The offset is then its posterior mean: camera times have a
    uniform error of up to half a frame, watch times a normal one of some milliseconds, so that many swings bound the
    offset more tightly than their mean does (for 10 at 30 Hz 2 ms, not 3 ms). Raises WearcapError as `fit_clock` does.
    """
    try:
        clock = fit_clock(camera_s, watch_s, max_offset_s)
    except WearcapError as error:
        raise WearcapError(
            error.what.replace("clap", "swing").replace("suit", "watch"),
            where="arm swings",
            expected=error.expected.replace("clap", "swing"),
            fix="Give the times of the frames in which the hands are highest, at uneven intervals.",
        ) from error
    ours = clock.to_camera(watch_s)
    gap = (camera_s[:, None] - ours).abs()
    nearest = gap.argmin(1)
    late = (camera_s - ours[nearest])[gap.min(1).values <= TOLERANCE_S + frame_s].numpy()
    half = frame_s / 2
    spread = max(_PEAK_S, float(np.sqrt(max(np.mean(late**2) - half**2 / 3, 0.0))))
    offset = np.linspace(-frame_s, frame_s, 801) + np.median(late)
    off = late[:, None] - offset
    # A likelihood floor of 0.001 for wrongly picked frames.
    likelihood = ndtr((off + half) / spread) - ndtr((off - half) / spread) + 1e-3
    posterior = np.exp(np.log(likelihood).sum(0) - np.log(likelihood).sum(0).max())
    posterior /= posterior.sum()
    mean = float(posterior @ offset)
    std = float(np.sqrt(posterior @ (offset - mean) ** 2))
    return SwingClock(replace(clock, camera_s=clock.camera_s + mean), std)


def swing_checks(found: SwingClock, joint: str, min_swings: int = 5, max_std_s: float = 0.005) -> list[StepCheck]:
    """Quality checks of the swings."""
    more = "Swing ten times, and give the frames in which the hands are nearest to the camera."
    return [
        StepCheck(
            f"arm swings, {joint}", "seen by both clocks", found.clock.claps, min_swings, "", more, at_least=True
        ),
        StepCheck(f"arm swings, {joint}", "deviation of the offset", 1000 * found.std_s, 1000 * max_std_s, "ms", more),
    ]
