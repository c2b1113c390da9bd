"""Clock synchronisation by common claps (thesis §4.3.4: one clap; clock drift of about 87 ms per hour)."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.recording import Recording

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
    """Number of common claps."""

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


def _through(time: Tensor, knots: Tensor, values: Tensor, rate: float) -> Tensor:
    """Linear between knots, beyond them with `rate`."""
    inside = time.clamp(knots[0], knots[-1])
    if len(knots) == 1:
        return values[0] + (time - inside) * rate
    after = torch.searchsorted(knots, inside.contiguous(), right=True).clamp(1, len(knots) - 1)
    slope = (values[after] - values[after - 1]) / (knots[after] - knots[after - 1])
    return values[after - 1] + (inside - knots[after - 1]) * slope + (time - inside) * rate


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
            raise WearcapError(
                f"no clap found by the {name}",
                expected="at least one that both clocks saw",
                fix="Give the times of the claps by hand.",
            )
    pairs = _matched(camera, suit, max_offset_s)
    camera, suit = camera[pairs[1]], suit[pairs[0]]
    rate = _drift(suit, camera)
    group = np.concatenate([[0], np.cumsum(np.diff(suit) > GROUP_S)])
    count = np.bincount(group)
    knots = [torch.from_numpy(np.bincount(group, times - times[0]) / count + times[0]) for times in (camera, suit)]
    clock = Clock(*knots, drift_s_per_hour=3600 * rate, residual_s=0.0, claps=len(suit))
    off = torch.from_numpy(camera) - clock.to_camera(torch.from_numpy(suit))
    return replace(clock, residual_s=off.square().mean().sqrt().item())


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
    best = np.argsort(-_agreement(camera, suit, start, offset), kind="stable")[:200]
    found: dict[bytes, tuple[float, float, tuple]] = {}
    for candidate in best:
        score, at, pairs = _refined(camera, suit, start[candidate], offset[candidate])
        found.setdefault(pairs[0].tobytes() + pairs[1].tobytes(), (score, at, pairs))
    ranked = sorted(found.values(), key=lambda entry: -entry[0])
    score, at, pairs = ranked[0]
    rivals = [other for other in ranked[1:] if abs(other[1] - at) > TOLERANCE_S and other[0] > score - 0.3]
    if rivals:
        nearest, *others = sorted([ranked[0], *rivals], key=lambda entry: abs(entry[1]))
        if abs(nearest[1]) + TOGETHER_S < abs(others[0][1]):
            return nearest[2]
        raise WearcapError(
            f"the {len(camera)} claps of the camera and {len(suit)} of the suit fit together in several ways, with "
            f"offsets of {at:.3f} s and {rivals[0][1]:.3f} s",
            expected="claps at uneven intervals, or one in each",
            fix="Give the times of the claps by hand.",
        )
    return pairs


def _agreement(camera: np.ndarray, suit: np.ndarray, start: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """How many claps coincide, nearer ones counting more, if those at `start` are `offset` apart."""
    score = np.empty(len(start))
    for first in range(0, len(start), 2000):
        part = slice(first, first + 2000)
        gap = _gap(camera, suit + offset[part, None])
        reach = TOLERANCE_S + MAX_DRIFT * np.abs(suit - start[part, None])
        score[part] = np.maximum(1 - (gap / reach) ** 2, 0).sum(1)
    return score


def _gap(times: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Distance from each of `at` to the nearest of the sorted `times`."""
    after = np.searchsorted(times, at).clip(0, len(times) - 1)
    return np.minimum(np.abs(times[after] - at), np.abs(times[(after - 1).clip(0)] - at))


def _refined(camera: np.ndarray, suit: np.ndarray, start: float, offset: float) -> tuple[float, float, tuple]:
    """Refit offset and drift to the coinciding claps iteratively: score, offset at the middle, pairs."""
    predicted, reach = suit + offset, TOLERANCE_S + MAX_DRIFT * np.abs(suit - start)
    for _ in range(8):
        gap = np.abs(predicted[:, None] - camera)
        nearest, back = gap.argmin(1), gap.argmin(0)
        of_suit = np.nonzero((back[nearest] == np.arange(len(suit))) & (gap.min(1) <= reach))[0]
        if not len(of_suit):
            break
        pairs = (of_suit, nearest[of_suit])
        score = np.maximum(1 - (gap[pairs] / reach[of_suit]) ** 2, 0).sum()
        gained = camera[pairs[1]] - suit[of_suit]
        rate = np.clip(_drift(suit[of_suit], camera[pairs[1]]), -MAX_DRIFT, MAX_DRIFT)
        middle = suit.mean()
        at = float(np.median(gained - rate * (suit[of_suit] - middle)))
        predicted = suit + at + rate * (suit - middle)
        reach = np.full(len(suit), TOLERANCE_S)
    return float(score), at, pairs
