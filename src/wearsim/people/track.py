"""Signals over time: keyed channels with minimum-jerk transitions, smooth noise, and filters without delay."""

from dataclasses import dataclass, field

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.spatial
from jaxtyping import Float


def ease(share: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Minimum-jerk profile from 0 to 1 while `share` runs from 0 to 1 (Flash and Hogan 1985); constant outside."""
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 + u * (6.0 * u - 15.0)))


def hermite(
    share: Float[np.ndarray, "*batch"],
    value: tuple[Float[np.ndarray, "*#batch"], Float[np.ndarray, "*#batch"]],
    slope: tuple[Float[np.ndarray, "*#batch"], Float[np.ndarray, "*#batch"]],
) -> Float[np.ndarray, "*batch"]:
    """Quintic between two values with given slopes per unit of `share` and no curvature at either end."""
    u = np.clip(share, 0.0, 1.0)
    rise = value[1] - value[0]
    leave = u - u**3 * (6.0 + u * (3.0 * u - 8.0))
    arrive = u**3 * (7.0 * u - 4.0 - 3.0 * u * u)
    return value[0] + rise * ease(u) + slope[0] * leave + slope[1] * arrive


@dataclass
class Track:
    """A channel of numbers with constant values and minimum-jerk transitions between them.

    Transitions may overlap: each adds its own rise, so the sum stays twice continuously differentiable.
    """

    initial: Float[np.ndarray, "feature"]
    _moves: list[tuple[float, float, np.ndarray]] = field(default_factory=list)
    last: Float[np.ndarray, "feature"] = field(init=False)
    """Value of the channel after its last transition."""

    def __post_init__(self):
        self.last = self.initial.astype(np.float64)

    def move(self, start_s: float, stop_s: float, value) -> None:
        """Go to `value` between two times (s); equal times mean a jump."""
        value = np.broadcast_to(np.asarray(value, np.float64), self.last.shape)
        self._moves.append((start_s, max(stop_s, start_s + 1e-6), value - self.last))
        self.last = value.copy()

    def visit(self, value, out: tuple[float, float], back: tuple[float, float]) -> None:
        """Go to `value` in one interval of time and to zero in another (s)."""
        self.move(*out, value)
        self.move(*back, 0.0)

    def sample(self, times: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time feature"]:
        """Values at rising times (s). Loops over transitions, each touching only its own frames."""
        out = np.zeros((len(times) + 1, len(self.initial)))
        steps = np.zeros_like(out)
        for start, stop, rise in self._moves:
            first, last = np.searchsorted(times, (start, stop))
            out[first:last] += ease((times[first:last] - start) / (stop - start))[:, None] * rise
            steps[last] += rise
        return (self.initial + out + np.cumsum(steps, 0))[:-1]


def blur(signal: np.ndarray, sigma_s: float, fps: float) -> np.ndarray:
    """Gaussian average along the first axis (time), the ends extended."""
    return scipy.ndimage.gaussian_filter1d(signal, sigma_s * fps, axis=0, mode="nearest", truncate=3.5)


def lower_envelope(signal: Float[np.ndarray, "time"], half_width_s: float, fps: float) -> Float[np.ndarray, "time"]:
    """A smooth curve that nowhere exceeds the signal: minimum over a window, then a mean over the same window."""
    half = max(round(half_width_s * fps), 1)
    lowest = scipy.ndimage.minimum_filter1d(signal, 2 * half + 1, mode="nearest")
    kernel = np.convolve(np.hanning(half + 3)[1:-1], np.hanning(half + 3)[1:-1])
    return scipy.ndimage.convolve1d(lowest, kernel / kernel.sum(), mode="nearest")


def falling_at_most(signal: Float[np.ndarray, "time"], acceleration: float, fps: float) -> Float[np.ndarray, "time"]:
    """The highest curve that nowhere exceeds the signal and never curves down by more than `acceleration` (per s²).

    With acceleration · t² / 2 added, such a curve is convex: it is the lower convex hull of the signal so raised.
    """
    if len(signal) < 3:
        return signal
    time = (np.arange(len(signal)) - len(signal) / 2) / fps
    raised = signal + 0.5 * acceleration * time**2
    corners = scipy.spatial.ConvexHull(np.stack([time, raised], 1)).vertices  # counter-clockwise
    below = np.roll(corners, -int(corners.argmin()))
    below = below[: int(below.argmax()) + 1]
    return np.interp(time, time[below], raised[below]) - 0.5 * acceleration * time**2


def pendulum(pressure: Float[np.ndarray, "time feature"], rate: float, fps: float) -> Float[np.ndarray, "time feature"]:
    """The bounded centre of mass over a moving centre of pressure: x'' = rate² (x − p).

    The linear inverted pendulum's only solution that stays over the feet is p averaged with the two-sided kernel
    rate/2 · exp(−rate |t|), here as a causal and an anticausal first-order filter.
    """
    keep = np.exp(-rate / fps)
    out = pressure
    for _ in range(2):
        state = keep * out[:1]
        out = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], out, axis=0, zi=state)[0][::-1]
    return out


def wander(
    rng: np.random.Generator, length: int, features: int, period_s: float, std: float, fps: float
) -> Float[np.ndarray, "time feature"]:
    """Smooth zero-mean noise of a given deviation whose changes take about `period_s`."""
    spacing = period_s / 4
    knots = int(length / fps / spacing) + 9
    coarse = scipy.ndimage.gaussian_filter1d(rng.standard_normal((knots, features)), 1.5, axis=0)
    coarse /= np.sqrt(1 / (2 * np.sqrt(np.pi) * 1.5))
    place = np.arange(length) / fps / spacing + 3.0
    low = np.floor(place).astype(int)
    u = (place - low)[:, None]
    low = np.clip(low, 1, len(coarse) - 3)
    # a uniform cubic B-spline with the rows as control points is twice continuously differentiable
    weights = ((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3)
    return std * (np.sum([w * coarse[low + k - 1] for k, w in enumerate(weights)], 0) / 6.0)
