"""Contact probabilities to intervals with a fixed set of contacting hands (thesis §5.3.2)."""

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError


@dataclass(frozen=True)
class ContactSettings:
    """Threshold and gap filling. Raises WearcapError for a threshold outside 0…1 or a negative gap."""

    threshold: float = 0.5
    """Least probability of a contact."""
    gap_s: float = 0.5
    """Longest gap (s) between two contacts of a hand that is filled (thesis Table 5.4)."""

    def __post_init__(self):
        if not 0.0 < self.threshold < 1.0 or self.gap_s < 0:
            raise WearcapError(
                f"threshold {self.threshold}, gap {self.gap_s} s",
                expected="a probability between 0 and 1, and no negative time",
            )


@dataclass(frozen=True)
class ContactInterval:
    """Frames start … stop − 1 in which the same hands (left, right) are in contact."""

    start: int
    stop: int
    hands: tuple[bool, bool]


def active(
    contact_prob: Float[Tensor, "time hand"], timestamps: Float64[Tensor, "time"], settings: ContactSettings
) -> Bool[Tensor, "time hand"]:
    """Contacts of each hand after thresholding and gap filling."""
    above = contact_prob >= settings.threshold
    frames = torch.arange(len(above))[:, None].expand_as(above)
    last = torch.where(above, frames, -1).cummax(0).values
    following = torch.where(above, frames, len(above)).flip(0).cummin(0).values.flip(0)
    inside = (last >= 0) & (following < len(above))
    clamped = len(above) - 1
    gap = timestamps[following.clamp(max=clamped)] - timestamps[last.clamp(min=0)]
    return above | (inside & (gap <= settings.gap_s + 1e-9))


def contact_intervals(contact: Bool[Tensor, "time hand"]) -> list[ContactInterval]:
    """Runs of frames with the same non-empty set of contacting hands, in order of time."""
    if not len(contact):
        return []
    change = (contact[1:] != contact[:-1]).any(1).nonzero()[:, 0] + 1
    edges = [0, *change.tolist(), len(contact)]
    rows = [(a, b, contact[a].tolist()) for a, b in pairwise(edges)]
    return [ContactInterval(a, b, (bool(left), bool(right))) for a, b, (left, right) in rows if left or right]


@dataclass
class ContactStream:
    """Streaming version of `active` and `contact_intervals`: returns an interval as soon as it is certain to be over.

    A frame without contact is decided after `gap_s`, or earlier if contact returns. Memory is bounded by the gap.
    """

    settings: ContactSettings = field(default_factory=ContactSettings)
    _undecided: deque = field(default_factory=deque)
    """Undecided frames, oldest first: (index, time, above threshold per hand)."""
    _last: list[float] = field(default_factory=lambda: [-float("inf")] * 2)
    _now_s: float = -float("inf")
    _count: int = 0
    _open: tuple[int, tuple[bool, bool]] | None = None

    def push(self, contact_prob: Float[Tensor, "hand"], time_s: float) -> list[ContactInterval]:
        """Add one frame's probabilities; returns intervals that are over. Raises WearcapError unless time rises."""
        if not time_s > self._now_s:
            raise WearcapError(f"a frame at {time_s} s after one at {self._now_s} s", expected="rising times")
        self._now_s = time_s
        above = [bool(p >= self.settings.threshold) for p in contact_prob.tolist()]
        for hand in range(2):
            if above[hand]:
                if time_s - self._last[hand] <= self.settings.gap_s + 1e-9:
                    for _, time, contact in self._undecided:
                        contact[hand] |= time > self._last[hand]
                self._last[hand] = time_s
        self._undecided.append((self._count, time_s, above))
        self._count += 1
        return self._decided(time_s)

    def flush(self) -> list[ContactInterval]:
        """Return the remaining intervals at the end of the recording."""
        done = self._decided(float("inf"))
        return done + self._closed(self._count)

    def _decided(self, now_s: float) -> list[ContactInterval]:
        """Process frames that no later contact can change: every hand is in contact, or was released longer than the
        gap ago."""
        done = []
        while self._undecided:
            number, time, contact = self._undecided[0]
            if any(
                not on and last < time and now_s - last < self.settings.gap_s for on, last in zip(contact, self._last)
            ):
                break
            self._undecided.popleft()
            done += self._step(number, (contact[0], contact[1]))
        return done

    def _step(self, number: int, contact: tuple[bool, bool]) -> list[ContactInterval]:
        if self._open is not None and self._open[1] == contact:
            return []
        done = self._closed(number)
        if any(contact):
            self._open = (number, contact)
        return done

    def _closed(self, stop: int) -> list[ContactInterval]:
        if self._open is None:
            return []
        start, hands = self._open
        self._open = None
        return [ContactInterval(start, stop, hands)]
