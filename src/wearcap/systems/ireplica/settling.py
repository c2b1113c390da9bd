"""Refinement of contact intervals (ours): cuts off approach and retreat, as a hand is at rest when it takes and
releases.

The networks report contact during the approach to an object and the retreat from it too: some tenths of a second in
which the object would follow hands that do not hold it.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.systems.ireplica.contact_intervals import ContactInterval

Span = tuple[ContactInterval, str]


def settled(
    spans: list[Span], palms_world: Float[Tensor, "time hand 3"], timestamps: Float64[Tensor, "time"], settle_s: float
) -> list[Span]:
    """Cut approach and retreat off the intervals, each up to `settle_s` long.

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
        start = slowest(speed, hands_of(chain, first.start, reach), first.start, min(first.start + reach, middle))
        stop = slowest(speed, hands_of(chain, last.stop - reach, reach), max(last.stop - reach, middle), last.stop)
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
            before, before_class = chain[-1]
            shared = any(a and b for a, b in zip(before.hands, contact.hands))
            if before_class == contact_class and before.stop == contact.start and shared:
                chain.append((contact, contact_class))
                break
        else:
            found.append([(contact, contact_class)])
    return found


def hands_of(chain: list[Span], start: int, frames: int) -> Tensor:
    """Mask "hand" of the hands in contact within `frames` frames of a hold from `start` on."""
    near = [contact.hands for contact, _ in chain if contact.start < start + frames and contact.stop > start]
    return torch.tensor([any(column) for column in zip(*near)] if near else chain[0][0].hands)


def slowest(speed: Float[Tensor, "time hand"], hands: Tensor, start: int, stop: int) -> int:
    """Frame in start … stop − 1 with the least mean speed of the hands."""
    if stop <= start:
        return start
    return start + int(speed[start:stop, hands].mean(1).argmin())
