"""The active object over time: a condition of ECHO besides three tracked points."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.recording import Recording

MARGIN_S = 2.0
"""Time (s) before the first touch and after the last one in which an object counts as active."""
NO_OBJECT = -1
SAME_S = 1e-6
"""Times closer than this (s) are equal."""


@dataclass(frozen=True)
class ActiveSpan:
    """A time span (s) in which one object is active."""

    object: str
    start_s: float
    stop_s: float


def true_spans(recording: Recording, margin_s: float = MARGIN_S) -> list[ActiveSpan]:
    """Acts from the recording's interactions; without interactions, its only object is active throughout.

    Each object is active from `margin_s` before it is touched until `margin_s` after its release, or until half way to
    the next span. Raises WearcapError for several objects without interactions.
    """
    interactions = recording.interactions
    if interactions is None:
        objects = list(recording.object_motion)
        if not objects:
            return []
        if len(objects) > 1:
            what = f"{len(objects)} objects and no interactions to choose the active one"
            raise WearcapError(what, recording.name, "interactions, or a single object")
        times = recording.object_motion[objects[0]].timestamps
        return [ActiveSpan(objects[0], times[0].item(), times[-1].item() + 1.0)]
    spans = sorted(zip(interactions.start_s.tolist(), interactions.stop_s.tolist(), interactions.objects))
    return extended_spans([ActiveSpan(name, start, stop) for start, stop, name in spans if name], margin_s)


def extended_spans(held: Sequence[ActiveSpan], margin_s: float = MARGIN_S) -> list[ActiveSpan]:
    """Extend spans by `margin_s` beyond the time spans in which objects are held, without overlap.

    `held` is ordered by start; consecutive spans of one object are merged. An object held within the time span of
    another is the active one there; the other object is active before and after.
    """
    merged: list[ActiveSpan] = []
    for span in _side_by_side(held):
        if merged and merged[-1].object == span.object and span.start_s - merged[-1].stop_s < 2 * margin_s:
            merged[-1] = ActiveSpan(span.object, merged[-1].start_s, max(merged[-1].stop_s, span.stop_s))
        else:
            merged.append(span)
    middles = [(before.stop_s + after.start_s) / 2 for before, after in pairwise(merged)]
    edges = [-float("inf"), *middles, float("inf")]
    return [
        ActiveSpan(span.object, max(span.start_s - margin_s, edges[k]), min(span.stop_s + margin_s, edges[k + 1]))
        for k, span in enumerate(merged)
    ]


def changes(spans: Iterable[ActiveSpan]) -> list[tuple[float, str | None]]:
    """Times (s), rising, from which on another object is active, with its name; None: no object is.

    Where spans overlap the last one counts, as for `active_at`.
    """
    spans, found = list(spans), []
    active: str | None = None
    for time_s in sorted({edge for span in spans for edge in (span.start_s, span.stop_s)}):
        name = next((span.object for span in reversed(spans) if span.start_s <= time_s < span.stop_s), None)
        if name != active:
            found.append((time_s, name))
        active = name
    return found


def _side_by_side(held: Sequence[ActiveSpan]) -> list[ActiveSpan]:
    """Time spans of which none is within another: longer ones are split."""
    left, done = list(held), []
    while left:
        span = left.pop(0)
        within = (k for k, other in enumerate(left) if other.stop_s < span.stop_s and other.object != span.object)
        inner = next(within, None)
        if inner is not None:
            left.insert(inner + 1, ActiveSpan(span.object, left[inner].stop_s, span.stop_s))
            left.sort(key=lambda part: part.start_s)
            span = ActiveSpan(span.object, span.start_s, left[inner].start_s)
        if span.stop_s > span.start_s:
            done.append(span)
    return done


def active_at(
    spans: Iterable[ActiveSpan], names: Sequence[str], timestamps: Float64[Tensor, "time"]
) -> Int64[Tensor, "time"]:
    """Index in `names` of the active object at each time, `NO_OBJECT` where none is active.

    Raises WearcapError for a span of an object that is not among the names.
    """
    active = torch.full((len(timestamps),), NO_OBJECT)
    for span in spans:
        if span.object not in names:
            raise WearcapError(f"a span of {span.object!r}", expected=f"one of {', '.join(names) or 'no objects'}")
        ends = torch.tensor([span.start_s, span.stop_s], dtype=torch.float64) - SAME_S
        first, last = torch.searchsorted(timestamps, ends)
        active[int(first) : int(last)] = list(names).index(span.object)
    return active
