"""Contact probabilities to intervals with a fixed set of contacting hands (thesis §5.3.2)."""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.scene.objects import CONTACT_CLASSES


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

    def continues(self, before: "ContactInterval") -> bool:
        """Whether this interval follows another without a gap and shares a hand with it."""
        return before.stop == self.start and any(a and b for a, b in zip(before.hands, self.hands))


Span = tuple[ContactInterval, str]
"""A contact interval and its class of interaction."""


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


def class_intervals(
    contact_prob: dict[str, Float[Tensor, "time hand"]],
    timestamps: Float64[Tensor, "time"],
    contact: ContactSettings,
    one_class: bool,
) -> list[Span]:
    """Contact intervals of every class, in order of time. With `one_class`, a hand's less probable class is dropped."""
    if one_class and len(contact_prob) > 1:
        best = torch.stack(list(contact_prob.values())).amax(0)
        contact_prob = {name: torch.where(prob >= best, prob, 0.0) for name, prob in contact_prob.items()}
    found = [
        (interval, name)
        for name in CONTACT_CLASSES
        if name in contact_prob
        for interval in contact_intervals(active(contact_prob[name], timestamps, contact))
    ]
    return sorted(found, key=lambda row: (row[0].start, row[0].stop))


def settled(
    spans: list[Span], palms_world: Float[Tensor, "time hand 3"], timestamps: Float64[Tensor, "time"], settle_s: float
) -> list[Span]:
    """Cut approach and retreat off the intervals (ours), each up to `settle_s` long, as a hand is at rest when it
    takes and releases.

    The networks report contact during the approach to an object and the retreat from it too: some tenths of a second
    in which the object would follow hands that do not hold it.
    Consecutive intervals of a class that share a hand form one hold; it begins and ends where the hands that begin and
    end it are slowest. Intervals entirely before or after that are dropped.
    """
    if settle_s <= 0 or len(timestamps) < 3:
        return spans
    reach = max(1, round(settle_s / float(timestamps.diff().median())))
    speed = palms_world.diff(dim=0).norm(dim=-1) / timestamps.diff()[:, None].to(palms_world)
    speed = torch.cat([speed, speed[-1:]])
    kept: list[Span] = []
    for chain in chains(spans):
        first, last = chain[0][0], chain[-1][0]
        middle = (first.start + last.stop) // 2
        start = _slowest(speed, chain, first.start, reach, first.start, min(first.start + reach, middle))
        stop = _slowest(speed, chain, last.stop - reach, reach, max(last.stop - reach, middle), last.stop)
        for contact, contact_class in chain:
            cut = replace(contact, start=max(contact.start, start), stop=min(contact.stop, stop + 1))
            if cut.start < cut.stop:
                kept.append((cut, contact_class))
    return sorted(kept, key=lambda row: (row[0].start, row[0].stop))


def chains(spans: list[Span]) -> list[list[Span]]:
    """Group intervals into holds: intervals of one class that follow without a gap and share a hand."""
    found: list[list[Span]] = []
    for contact, contact_class in spans:
        for chain in reversed(found[-4:]):
            if chain[-1][1] == contact_class and contact.continues(chain[-1][0]):
                chain.append((contact, contact_class))
                break
        else:
            found.append([(contact, contact_class)])
    return found


def _slowest(speed: Float[Tensor, "time hand"], hold: list[Span], near: int, reach: int, start: int, stop: int) -> int:
    """Frame in start … stop − 1 with the least mean speed of the hands in contact within `reach` frames from `near`."""
    if stop <= start:
        return start
    rows = [contact.hands for contact, _ in hold if contact.start < near + reach and contact.stop > near]
    hands = torch.tensor([any(column) for column in zip(*rows)] if rows else hold[0][0].hands)
    return start + int(speed[start:stop, hands].mean(1).argmin())
