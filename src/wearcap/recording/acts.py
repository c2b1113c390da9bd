"""Which object a wearer is busy with at which time: what ECHO is told beside three tracked points."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.recording import Recording

MARGIN_S = 2.0
"""Before the first touch and after the last one, in which an object is the active one already and still."""
NO_OBJECT = -1
SAME_S = 1e-6
"""Times nearer than this are one."""


@dataclass(frozen=True)
class Act:
    """One object, active from one time to another (s)."""

    object: str
    start_s: float
    stop_s: float


def true_acts(recording: Recording, margin_s: float = MARGIN_S) -> list[Act]:
    """Acts as the recording's interactions tell them; with objects but no interactions: the only object, throughout.

    Each object is active from `margin_s` before it is touched until as long after it is let go, or until half way to
    the next one. Raises WearcapError where there are several objects and nothing tells which is active.
    """
    told = recording.interactions
    if told is None:
        objects = list(recording.object_motion)
        if not objects:
            return []
        if len(objects) > 1:
            raise WearcapError(f"{len(objects)} objects and no interactions that tell which is active", where=recording.name,
                               expected="interactions, or a single object")  # fmt: skip
        times = recording.object_motion[objects[0]].timestamps
        return [Act(objects[0], times[0].item(), times[-1].item() + 1.0)]
    spans = sorted(zip(told.start_s.tolist(), told.stop_s.tolist(), told.objects))
    return spread_acts([Act(name, start, stop) for start, stop, name in spans if name], margin_s)


def spread_acts(held: Sequence[Act], margin_s: float = MARGIN_S) -> list[Act]:
    """Acts that reach `margin_s` beyond the stretches in which objects are held, none into another.

    `held` is ordered by its start; stretches of one object that follow each other become one. Where one object is held
    within the time of another, it is the active one, and the other one before and behind.
    """
    merged: list[Act] = []
    for act in _side_by_side(held):
        if merged and merged[-1].object == act.object and act.start_s - merged[-1].stop_s < 2 * margin_s:
            merged[-1] = Act(act.object, merged[-1].start_s, max(merged[-1].stop_s, act.stop_s))
        else:
            merged.append(act)
    middles = [(before.stop_s + after.start_s) / 2 for before, after in pairwise(merged)]
    edges = [-float("inf"), *middles, float("inf")]
    return [
        Act(act.object, max(act.start_s - margin_s, edges[k]), min(act.stop_s + margin_s, edges[k + 1]))
        for k, act in enumerate(merged)
    ]


def _side_by_side(held: Sequence[Act]) -> list[Act]:
    """Stretches of which none lies within another: the longer one is cut."""
    left, done = list(held), []
    while left:
        act = left.pop(0)
        within = (
            k for k, other in enumerate(left) if other.stop_s < act.stop_s and other.object != act.object
        )
        inner = next(within, None)
        if inner is not None:
            left.insert(inner + 1, Act(act.object, left[inner].stop_s, act.stop_s))
            left.sort(key=lambda part: part.start_s)
            act = Act(act.object, act.start_s, left[inner].start_s)
        if act.stop_s > act.start_s:
            done.append(act)
    return done


def active_at(
    acts: Iterable[Act], names: Sequence[str], timestamps: Float64[Tensor, "time"]
) -> Int64[Tensor, "time"]:
    """Number in `names` of the object that is active at each time, `NO_OBJECT` where none is.

    Raises WearcapError for an act of an object that is not among the names.
    """
    active = torch.full((len(timestamps),), NO_OBJECT)
    for act in acts:
        if act.object not in names:
            raise WearcapError(f"an act of {act.object!r}", expected=f"one of {', '.join(names) or 'no objects'}")  # fmt: skip
        ends = torch.tensor([act.start_s, act.stop_s], dtype=torch.float64) - SAME_S
        first, last = torch.searchsorted(timestamps, ends)
        active[int(first) : int(last)] = list(names).index(act.object)
    return active
