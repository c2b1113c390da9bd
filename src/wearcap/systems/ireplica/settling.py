"""Ours: when hands truly hold on. A hand rests where it takes a thing and where it lets go of it.

A network sees the approach to a thing and the retreat from it before and after the contact itself: some tenths of a
second in which the object would follow hands that do not hold it.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.systems.ireplica.contact_intervals import ContactInterval

Span = tuple[ContactInterval, str]


def settled(
    spans: list[Span],
    palms_world: Float[Tensor, "time hand 3"],
    timestamps: Float64[Tensor, "time"],
    settle_s: float,
) -> list[Span]:
    """The intervals without the approach at their beginning and the retreat at their end, each up to `settle_s` long.

    Intervals of a class that follow each other while a hand stays on are one hold: it begins and ends where the hands
    that begin and end it are slowest. Intervals that lie in front of or behind that are left out.
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
        start = slowest(
            speed, hands_of(chain, first.start, reach), first.start, min(first.start + reach, middle)
        )
        stop = slowest(
            speed, hands_of(chain, last.stop - reach, reach), max(last.stop - reach, middle), last.stop
        )
        for contact, contact_class in chain:
            cut = replace(contact, start=max(contact.start, start), stop=min(contact.stop, stop + 1))
            if cut.start < cut.stop:
                kept.append((cut, contact_class))
    return sorted(kept, key=lambda row: (row[0].start, row[0].stop))


def chains(spans: list[Span]) -> list[list[Span]]:
    """Intervals of one class, each beginning where another ends and sharing a hand with it, together."""
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
    """Which hands are in contact within some frames of a hold: "hand"."""
    near = [contact.hands for contact, _ in chain if contact.start < start + frames and contact.stop > start]
    return torch.tensor([any(column) for column in zip(*near)] if near else chain[0][0].hands)


def slowest(speed: Float[Tensor, "time hand"], hands: Tensor, start: int, stop: int) -> int:
    """The frame in start … stop − 1 at which the hands' mean speed is least."""
    if stop <= start:
        return start
    return start + int(speed[start:stop, hands].mean(1).argmin())
