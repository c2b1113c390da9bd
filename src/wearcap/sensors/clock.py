"""Clock synchronisation by common events: claps (thesis §4.3.4: one clap; clock drift of about 87 ms per hour), or arm
swings, the times of the highest forearm against those of the hands nearest to the camera (MocapEvery, appendix C.2:
more reliable than claps, whose impact may disturb a wrist sensor).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch
from jaxtyping import Float64, Int64
from scipy.special import ndtr
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording.recording import ImuStream, Recording
from wearcap.sensors.stillness import StepCheck, Stretch

TOLERANCE_S = 0.03
"""Largest error of a clap under the fitted clock."""
MAX_DRIFT = 0.2 / 3600
"""Largest clock drift (seconds per second)."""
GROUP_S = 5.0
"""Claps closer together than this share one knot."""
PRIOR_SPREAD_S = 110.0
"""Prior on the drift, as an equivalent spread of claps: 3 ms of clap noise against a usual drift of 100 ms/h."""
TOGETHER_S = 60.0
"""Among equally good offsets, one smaller than all others by this is chosen: recorders start at about the same time."""
_MIN_RISE_DEG, _MIN_HEIGHT_DEG, _MIN_APART_S = 50.0, -10.0, 0.5
"""Smallest prominence and height of a peak of the forearm's elevation that is a swing, and time between two."""
_STEP_S = 0.01
"""Time step of the resampled elevations (100 Hz)."""
_TREMOR_S = 0.03
"""Standard deviation of the Gaussian that smooths the elevations."""
_TOP_S = 0.1
"""Half width of the parabola fit around a peak."""
_PEAK_S = 0.002
"""Standard deviation of a watch's peak time (simulated watches: below 1 ms), with a margin for uneven swings."""


@dataclass(frozen=True)
class Clock:
    """Map between a camera's and a suit's time (s): through its knots, beyond them with the mean drift."""

    camera_s: Float64[Tensor, "knot"]
    suit_s: Float64[Tensor, "knot"]
    drift_s_per_hour: float
    """Drift of the camera's clock relative to the suit's, over all knots."""
    residual_s: float
    """Root mean square error of the claps under the map; 0 with one clap per knot."""
    claps: int
    """Number of common claps, or arm swings."""
    std_s: float = 0.0
    """Standard deviation of the offset at swings."""

    @property
    def offset_s(self) -> float:
        """Camera time minus suit time at the first knot."""
        return (self.camera_s[0] - self.suit_s[0]).item()

    def to_camera(self, suit_s: Float64[Tensor, "*time"]) -> Float64[Tensor, "*time"]:
        """The camera's time at a time of the suit."""
        return _through(suit_s, self.suit_s, self.camera_s, 1 + self.drift_s_per_hour / 3600)

    def to_suit(self, camera_s: Float64[Tensor, "*time"]) -> Float64[Tensor, "*time"]:
        """The suit's time at a time of the camera."""
        return _through(camera_s, self.camera_s, self.suit_s, 1 / (1 + self.drift_s_per_hour / 3600))

    def checks(self, joint: str) -> list[StepCheck]:
        """Quality checks of a clock that is known from swings."""
        more = "Swing ten times, and give the frames in which the hands are nearest to the camera."
        step = f"arm swings, {joint}"
        return [
            StepCheck(step, "seen by both clocks", self.claps, 5, "", more, at_least=True),
            StepCheck(step, "deviation of the offset", 1000 * self.std_s, 5.0, "ms", more),
        ]


def _through(time: Tensor, knots: Tensor, values: Tensor, rate: float) -> Tensor:
    """Linear between knots, beyond them with `rate`."""
    return interpolate_clamped(knots, values, time) + (time - time.clamp(knots[0], knots[-1])) * rate


def fit_clock(
    claps_camera: Float64[Tensor, "clap_camera"], claps_suit: Float64[Tensor, "clap_suit"], max_offset_s: float = 600.0
) -> Clock:
    """The clock under which most claps of the two lists (s, any order) coincide; either list may miss some.

    One common clap gives the offset, claps at several times also the drift. Raises WearcapError when a list is
    empty, when no pair is less than `max_offset_s` apart, and when two offsets fit equally
    well, neither of them smaller by a minute.
    """
    camera, suit = (np.sort(claps.numpy()) for claps in (claps_camera, claps_suit))
    for name, claps in (("camera", camera), ("suit", suit)):
        if not len(claps):
            fix = "Give the times of the claps by hand."
            raise WearcapError(f"no clap found by the {name}", expected="at least one that both clocks saw", fix=fix)
    pairs = _matched(camera, suit, max_offset_s)
    camera, suit = camera[pairs[1]], suit[pairs[0]]
    rate = _drift(suit, camera)
    group = np.concatenate([[0], np.cumsum(np.diff(suit) > GROUP_S)])
    count = np.bincount(group)
    knots = [torch.from_numpy(np.bincount(group, times - times[0]) / count + times[0]) for times in (camera, suit)]
    clock = Clock(*knots, drift_s_per_hour=3600 * rate, residual_s=0.0, claps=len(suit))
    off = torch.from_numpy(camera) - clock.to_camera(torch.from_numpy(suit))
    return replace(clock, residual_s=off.square().mean().sqrt().item())


def require_overlap(times: Mapping[str, Float64[Tensor, "_"]], fix: str) -> None:
    """Raise WearcapError, with all spans, unless streams share at least a second of one clock."""
    spans = {name: (stamps[0].item(), stamps[-1].item()) for name, stamps in times.items() if len(stamps)}
    shared = min(stop for _, stop in spans.values()) - max(start for start, _ in spans.values())
    if shared < 1.0:
        listed = ", ".join(f"{name} from {start:.2f} to {stop:.2f} s" for name, (start, stop) in spans.items())
        what = f"{listed}: they share {max(shared, 0):.2f} s"
        raise WearcapError(what, where="logs", expected="logs of one session on one clock", fix=fix)


def retime(recording: Recording, clock: Clock) -> Recording:
    """The recording with its camera and its localisation on the suit's clock."""
    moved = {
        name: replace(stream, timestamps=clock.to_suit(stream.timestamps))
        for name in ("camera", "localization")
        if (stream := getattr(recording, name)) is not None
    }
    return replace(recording, **moved)


def _drift(suit: np.ndarray, camera: np.ndarray) -> float:
    """Slope of camera minus suit time over suit time, shrunk to zero where the claps are close together."""
    time, gained = suit - suit.mean(), (camera - camera.mean()) - (suit - suit.mean())
    return float((time * gained).sum() / ((time**2).sum() + PRIOR_SPREAD_S**2))


def mutual_pairs(
    a: Float64[np.ndarray, "a"], b: Float64[np.ndarray, "b"], reach: float | Float64[np.ndarray, "a"]
) -> tuple[Int64[np.ndarray, "pair"], Int64[np.ndarray, "pair"]]:
    """Indices (of a, of b) of times that are each other's nearest and at most `reach` (s) apart."""
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    gap = np.abs(a[:, None] - b)
    to_b, to_a = gap.argmin(1), gap.argmin(0)
    of_a = np.flatnonzero((to_a[to_b] == np.arange(len(a))) & (gap.min(1) <= reach))
    return of_a, to_b[of_a]


def _matched(camera: np.ndarray, suit: np.ndarray, max_offset_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices of common claps, (of suit, of camera)."""
    start, offset = (array.ravel() for array in np.broadcast_arrays(suit[:, None], camera - suit[:, None]))
    start, offset = start[np.abs(offset) <= max_offset_s], offset[np.abs(offset) <= max_offset_s]
    if not len(offset):
        raise WearcapError(
            f"no clap of the suit (first {suit[0]:.1f} s) is less than {max_offset_s:.0f} s from one of the camera "
            f"(first {camera[0]:.1f} s)",
            expected="clocks that are nearer to each other",
            fix="Raise max_offset_s.",
        )
    # How many claps coincide, nearer ones counting more, if those at `start` are `offset` apart.
    score = np.empty(len(start))
    for first in range(0, len(start), 2000):
        part = slice(first, first + 2000)
        at = suit + offset[part, None]
        after = np.searchsorted(camera, at).clip(0, len(camera) - 1)
        gap = np.minimum(np.abs(camera[after] - at), np.abs(camera[(after - 1).clip(0)] - at))
        reach = TOLERANCE_S + MAX_DRIFT * np.abs(suit - start[part, None])
        score[part] = np.maximum(1 - (gap / reach) ** 2, 0).sum(1)
    found: dict[bytes, tuple[float, float, tuple]] = {}
    for candidate in np.argsort(-score, kind="stable")[:200]:
        # Refit offset and drift to the coinciding claps iteratively: score, offset at the middle, pairs
        predicted, within_s = suit + offset[candidate], TOLERANCE_S + MAX_DRIFT * np.abs(suit - start[candidate])
        for _ in range(8):
            mutual = mutual_pairs(predicted, camera, within_s)
            if not len(mutual[0]):
                break
            pairs = of_suit, of_camera = mutual
            total = np.maximum(1 - (np.abs(predicted[of_suit] - camera[of_camera]) / within_s[of_suit]) ** 2, 0).sum()
            rate = np.clip(_drift(suit[of_suit], camera[of_camera]), -MAX_DRIFT, MAX_DRIFT)
            middle = suit.mean()
            lag = float(np.median(camera[of_camera] - suit[of_suit] - rate * (suit[of_suit] - middle)))
            predicted = suit + lag + rate * (suit - middle)
            within_s = np.full(len(suit), TOLERANCE_S)
        refined = float(total), lag, pairs
        found.setdefault(refined[2][0].tobytes() + refined[2][1].tobytes(), refined)
    best, *others = sorted(found.values(), key=lambda entry: -entry[0])
    rivals = [other for other in others if abs(other[1] - best[1]) > TOLERANCE_S and other[0] > best[0] - 0.3]
    if not rivals:
        return best[2]
    nearest, *others = sorted([best, *rivals], key=lambda entry: abs(entry[1]))
    if abs(nearest[1]) + TOGETHER_S < abs(others[0][1]):
        return nearest[2]
    raise WearcapError(
        f"the {len(camera)} claps of the camera and {len(suit)} of the suit fit together in several ways, with "
        f"offsets of {best[1]:.3f} s and {rivals[0][1]:.3f} s",
        expected="claps at uneven intervals, or one in each",
        fix="Give the times of the claps by hand.",
    )


def swing_peaks(stream: ImuStream, stretch: Stretch | None = None) -> Float64[Tensor, "swing"]:
    """Times (s, the stream's clock) at which the forearm is highest, finer than samples: the top of a parabola.

    Where the mounting is unknown the forearm is the watch's x axis, with the sign that lets the hand hang most of the
    time. Only the direction of gravity counts, so that any reference frame with z up will do.
    Raises WearcapError when there is no swing in the stretch (whole log by default), and without orientation.
    """
    times = stream.timestamps.numpy()
    start, stop = stretch or (times[0], times[-1])
    grid = np.arange(max(start, times[0]), min(stop, times[-1]), _STEP_S)
    none = WearcapError(
        f"no arm swing from {start:.1f} s to {stop:.1f} s",
        where=stream.joint,
        expected=f"a forearm that rises by {_MIN_RISE_DEG:g}° and falls again",
        fix="Swing the stretched arms from hanging to above the shoulders, ten times.",
    )
    if len(grid) < 2 * _TOP_S / _STEP_S + 3:
        raise none
    if stream.R_world_imu is None:
        raise WearcapError("a stream without orientation", where=stream.joint, expected="a watch's attitude")
    up_imu = stream.R_world_imu[:, 2]
    if stream.R_joint_imu is not None:
        side = -1.0 if stream.joint.startswith("right") else 1.0
        sine = side * up_imu @ stream.R_joint_imu[1].to(up_imu)
    else:
        sine = up_imu[:, 0]
        sine = sine if sine.median() <= 0 else -sine
    elevation = np.rad2deg(np.interp(grid, times, sine.clamp(-1, 1).asin().double().numpy()))
    smooth = scipy.ndimage.gaussian_filter1d(elevation, _TREMOR_S / _STEP_S)
    apart = max(round(_MIN_APART_S / _STEP_S), 1)
    tops, _ = scipy.signal.find_peaks(smooth, height=_MIN_HEIGHT_DEG, prominence=_MIN_RISE_DEG, distance=apart)
    reach = round(_TOP_S / _STEP_S)
    tops = tops[(tops >= reach) & (tops < len(smooth) - reach)]
    if not len(tops):
        raise none
    shift = np.arange(-reach, reach + 1)
    quadratic, linear, _ = np.polyfit(shift, smooth[tops[:, None] + shift].T, 2)
    finer = np.clip(-linear / (2 * np.minimum(quadratic, -1e-9)), -reach, reach)
    return torch.from_numpy(grid[0] + (tops + finer) * _STEP_S)


def fit_swing_clock(
    camera_s: Float64[Tensor, "swing_camera"], watch_s: Float64[Tensor, "swing_watch"], frame_s: float
) -> Clock:
    """Fit the clock that maps the watch's swings to the camera's, whose times are accurate to half a frame.

    `fit_clock` finds the correspondences and the drift. The offset is then its posterior mean: camera times have a
    uniform error of up to half a frame, watch times a normal one of some milliseconds, so that many swings bound the
    offset more tightly than their mean does (for 10 at 30 Hz 2 ms, not 3 ms). Raises WearcapError as `fit_clock` does.
    """
    try:
        clock = fit_clock(camera_s, watch_s)
    except WearcapError as error:
        what = error.what.replace("clap", "swing").replace("suit", "watch")
        expected = error.expected.replace("clap", "swing")
        fix = "Give the times of the frames in which the hands are highest, at uneven intervals."
        raise WearcapError(what, where="arm swings", expected=expected, fix=fix) from error
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
    return replace(clock, camera_s=clock.camera_s + mean, std_s=std)
