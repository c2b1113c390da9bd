"""Feet that are believed to stand: how far each must be moved so that it neither slides nor sinks into the floor.

A foot's displacement is that of its ankle; its orientation stays. While a foot is in contact, its lowest point (heel or
toe tip, whichever it is in a frame) keeps its place, so that a foot may roll from heel to toe. Outside of contacts the
displacement fades, so that swinging feet meet and leave their places softly.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import lfilter
from torch import Tensor

from wearcap.body.skeleton import FEET


@dataclass(frozen=True)
class FootLock:
    """When a foot counts as standing, and how it is held. Durations are in frames."""

    begin_prob: float
    """Contact probability above which a foot begins to stand."""
    end_prob: float
    """Contact probability below which it ends to stand; between the two nothing changes."""
    shortest: int
    """Fewest frames of a contact; shorter ones are ignored."""
    settle: int
    """Frames at a contact's beginning whose mean place the foot is put on."""
    fade: int
    """Frames over which a displacement fades in before a contact and out after it."""
    fastest_m_s: float
    """Speed of the predicted foot above which it does not stand, whatever its contact probability."""
    farthest_m: float
    """Largest horizontal displacement of a foot; beyond it a foot slides."""
    leak_s: float
    """Time constant (s) with which a standing foot's displacement decays, so that errors do not add up."""
    floor_within_m: float
    """Largest distance of a standing foot from the floor that is closed; at twice as much nothing is changed, as the foot
    then stands on something else."""
    raise_m: float
    """Largest depth from which a foot is raised to the floor; at twice as much nothing is changed."""

    @property
    def lookahead(self) -> int:
        """Frames after a frame that decide on its displacement."""
        return self.fade + max(self.settle, self.shortest)


NEVER = 1_000_000
"""Frames to a contact that does not exist."""


@dataclass
class FootState:
    """What is known of one foot before the frames that come next."""

    believed: bool = False
    """Whether contact was believed in the last frame."""
    stands: bool = False
    """Whether the foot was held in the last frame."""
    kept: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """Displacement (m) that keeps its lowest point where it was, in the last frame of contact."""
    offset: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """The same, limited and with the floor considered."""
    since: int = NEVER
    """Number of frames from that one to the next frame."""
    points: Float[Tensor, "point 3"] | None = None
    """Heel and toe tip (m) in the last frame; None: there is none."""


def displacements(
    how: FootLock,
    points: Float[Tensor, "time foot point 3"],
    contact_prob: Float[Tensor, "time foot"],
    floor_height: Float[Tensor, "time"],
    fps: float,
    states: tuple[FootState, ...],
    final: int,
) -> tuple[Float[Tensor, "final foot 3"], tuple[FootState, ...]]:
    """Displacements (m) of both feet in the first `final` frames, and the states after those.

    `points`: heel and toe tip (m); the frames from `final` on, at least `how.lookahead` unless a recording ends, are
    looked at alone.
    """
    feet = [
        _Foot(how, points[:, foot].double().numpy(), contact_prob[:, foot].double().numpy(), fps, states[foot])
        for foot in range(FEET)
    ]
    floor = floor_height.double().numpy()
    offsets = [foot.offsets(floor)[:final] for foot in feet]
    return torch.from_numpy(np.stack(offsets, 1)), tuple(foot.state(final) for foot in feet)


class _Foot:
    """One foot over some frames."""

    def __init__(self, how: FootLock, points: np.ndarray, prob: np.ndarray, fps: float, before: FootState):
        self.how, self.points, self.before, self.leak = how, points, before, 1 - 1 / (how.leak_s * fps)
        first = points[:1] if before.points is None else before.points.numpy()[None]
        self.low = points[..., 2].argmin(1)
        frames = np.arange(len(points))
        self.step = np.diff(points, axis=0, prepend=first)[frames, self.low]
        """Movement (m) of the lowest point since the frame before."""
        speed = np.linalg.norm(self.step, axis=1) * fps
        self.believed = _hysteresis(np.where(speed > how.fastest_m_s, 0.0, prob), how, before.believed)
        edges = np.flatnonzero(np.diff(self.believed.astype(int), prepend=0, append=0))
        self.height = points[frames, self.low, 2]
        self.held = np.zeros(len(points), bool)
        self.kept = np.zeros((len(points), 3))
        """Displacements (m) that keep the lowest point of a standing foot where it was."""
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist()):
            self._hold(start, stop)

    def _hold(self, start: int, stop: int) -> None:
        """Hold the foot from frame `start` to `stop` - 1, unless the contact is too short."""
        goes_on = start == 0 and self.before.believed
        if not self.before.stands if goes_on else stop - start < self.how.shortest:
            return
        step = -self.step[start:stop]
        if goes_on:
            begin = self.leak * self.before.kept.numpy()
            kept = lfilter([1.0], [1.0, -self.leak], step, axis=0, zi=begin[None])[0]
        else:
            step[0] = 0
            kept = lfilter([1.0], [1.0, -self.leak], step, axis=0)
            kept -= np.median(kept[: self.how.settle], axis=0) * self.leak ** np.arange(len(step))[:, None]
        self.kept[start:stop] = kept
        self.held[start:stop] = True

    def offsets(self, floor: np.ndarray) -> np.ndarray:
        """Displacements (m) of all frames."""
        how, frames, held = self.how, np.arange(len(self.points)), np.flatnonzero(self.held)
        # A standing foot is put on the floor, where that is near; `before` holds the last frame of contact before all.
        offset = self.kept[held]
        distance = np.linalg.norm(offset[:, :2], axis=1, keepdims=True)
        offset[:, :2] *= how.farthest_m / np.maximum(distance, how.farthest_m)
        offset[:, 2] += _near((floor - self.height)[held] - offset[:, 2], how.floor_within_m)
        offset = np.concatenate([self.before.offset.numpy()[None], offset, np.zeros((1, 3))])
        when = np.concatenate([[-self.before.since], held, [NEVER]])
        place = np.searchsorted(held, frames, side="right")
        after = np.minimum(place + 1 - self.held, len(when) - 1)
        out = _fading((frames - when[place]) / (how.fade + 1))[:, None]
        into = np.where(self.held, 0, _fading((when[after] - frames) / (how.fade + 1)))[:, None]
        self.offset = (offset[place] * out + offset[after] * into) / np.maximum(out + into, 1)
        self.offset[:, 2] += np.maximum(_near(floor - self.height - self.offset[:, 2], how.raise_m), 0)
        return self.offset

    def state(self, final: int) -> FootState:
        """The state after `final` frames."""
        if not final:
            return self.before
        held = np.flatnonzero(self.held[:final])
        kept, offset, since = self.before.kept, self.before.offset, self.before.since + final
        if len(held):
            kept, offset = (torch.from_numpy(part[held[-1]].copy()) for part in (self.kept, self.offset))
            since = final - int(held[-1])
        points = torch.from_numpy(self.points[final - 1].copy())
        return FootState(bool(self.believed[final - 1]), bool(self.held[final - 1]), kept, offset, since, points)


def _hysteresis(prob: np.ndarray, how: FootLock, believed: bool) -> np.ndarray:
    """Whether contact is believed: since the probability was above `begin_prob`, until it is below `end_prob`."""
    decides = (prob > how.begin_prob) | (prob < how.end_prob)
    last = np.maximum.accumulate(np.where(decides, np.arange(len(prob)), -1))
    return np.where(last >= 0, prob[np.maximum(last, 0)] > how.begin_prob, believed)


def _near(gap: np.ndarray, within_m: float) -> np.ndarray:
    """The gap (m) up to `within_m`, from there less and less, 0 at twice as much."""
    return np.sign(gap) * np.maximum(np.minimum(np.abs(gap), 2 * within_m - np.abs(gap)), 0)


def _fading(share: np.ndarray) -> np.ndarray:
    """From 1 at 0 to 0 at 1, without a jump of the speed."""
    rest = 1 - np.clip(share, 0, 1)
    return rest * rest * (3 - 2 * rest)
