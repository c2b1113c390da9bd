"""Which object is active when: as interactions give it, with a margin, and never two at a time."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from carried_box import carrying
from wearcap.errors import WearcapError
from wearcap.recording.active_objects import NO_OBJECT, ActiveSpan, active_at, changes, extended_spans, true_spans
from wearcap.recording.motion import Interactions

TIMES = torch.arange(0, 20, 0.5, dtype=torch.float64)


def listed(spans) -> list[tuple[str, float, float]]:
    return [(span.object, span.start_s, span.stop_s) for span in spans]


def test_an_act_reaches_beyond_what_is_held():
    assert listed(extended_spans([ActiveSpan("a", 5.0, 6.0)], 2.0)) == [("a", 3.0, 8.0)]


def test_changes_are_of_what_is_active():
    """Of spans that overlap, touch and enclose each other."""
    draw = torch.Generator().manual_seed(0)
    for _ in range(50):
        edges = torch.randint(0, 16, (4, 2), generator=draw).sort(1).values.tolist()
        spans = [ActiveSpan(name, float(start), float(stop)) for name, (start, stop) in zip("abab", edges)]
        found = changes(spans)
        assert [time for time, _ in found] == sorted({time for time, _ in found})
        assert all(before[1] != after[1] for before, after in pairwise(found))
        given = active_at(spans, "ab", TIMES)
        for time, active in zip(TIMES.tolist(), given.tolist()):
            name = next((name for start, name in reversed(found) if start <= time), None)
            assert name == (None if active == NO_OBJECT else "ab"[active])


def test_neighbours_meet_half_way():
    spans = extended_spans([ActiveSpan("a", 5.0, 6.0), ActiveSpan("b", 8.0, 9.0)], 2.0)
    assert listed(spans) == [("a", 3.0, 7.0), ("b", 7.0, 11.0)]


def test_neighbours_that_are_far_keep_their_margins():
    spans = extended_spans([ActiveSpan("a", 0.0, 1.0), ActiveSpan("b", 9.0, 10.0)], 2.0)
    assert listed(spans) == [("a", -2.0, 3.0), ("b", 7.0, 12.0)]


@pytest.mark.parametrize(("again", "count"), [(3.9, 1), (5.1, 2)])
def test_an_object_that_is_soon_touched_again_stays_the_active_one(again, count):
    spans = extended_spans([ActiveSpan("a", 0.0, 1.0), ActiveSpan("a", again, 6.0)], 2.0)
    assert len(spans) == count
    assert spans[-1].stop_s == 8.0


def test_another_object_between_keeps_two_stretches_apart():
    spans = extended_spans([ActiveSpan("a", 0.0, 1.0), ActiveSpan("b", 1.5, 2.0), ActiveSpan("a", 2.5, 3.0)], 2.0)
    assert listed(spans) == [("a", -2.0, 1.25), ("b", 1.25, 2.25), ("a", 2.25, 5.0)]


@pytest.mark.parametrize(
    "held",
    [
        [ActiveSpan("a", 2.0, 15.0), ActiveSpan("b", 5.0, 6.0)],  # within
        [ActiveSpan("a", 2.0, 8.0), ActiveSpan("b", 5.0, 12.0)],  # overlapping
        [ActiveSpan("a", 2.0, 15.0), ActiveSpan("b", 5.0, 6.0), ActiveSpan("c", 9.0, 10.0)],
        [ActiveSpan("a", 2.0, 15.0), ActiveSpan("b", 5.0, 6.0), ActiveSpan("a", 15.5, 16.0)],
        [
            ActiveSpan("a", 0.0, 10.0),
            ActiveSpan("a", 1.0, 2.0),
            ActiveSpan("b", 4.0, 5.0),
        ],  # a second hand on the same object
    ],
)
def test_of_objects_that_are_held_at_once_each_has_its_time(held):
    """One hand may open a door while the other carries."""
    spans = extended_spans(held, 1.0)
    assert {span.object for span in spans} == {span.object for span in held}
    assert all(span.stop_s > span.start_s for span in spans)
    assert all(before.stop_s <= after.start_s for before, after in pairwise(spans))
    active = active_at(spans, ["a", "b", "c"], TIMES)
    for k, time in enumerate(TIMES.tolist()):
        holding = {span.object for span in held if span.start_s <= time < span.stop_s}
        if holding:
            assert active[k] != NO_OBJECT, time
            assert ["a", "b", "c"][int(active[k])] in holding, time


def test_who_is_active_at_which_time():
    spans = [ActiveSpan("b", 2.0, 3.0), ActiveSpan("a", 3.0, 4.5)]
    active = active_at(spans, ["a", "b"], TIMES)
    assert active[TIMES < 2].eq(NO_OBJECT).all()
    assert active[(TIMES >= 2) & (TIMES < 3)].eq(1).all()
    assert active[(TIMES >= 3) & (TIMES < 4.5)].eq(0).all()
    assert active[TIMES >= 4.5].eq(NO_OBJECT).all()


@pytest.mark.parametrize(("names", "expected"), [(["a"], "one of a"), ([], "one of no objects")])
def test_an_act_of_an_unknown_object_is_named(names, expected):
    with pytest.raises(WearcapError, match=f"a span of 'ghost'. Expected {expected}"):
        active_at([ActiveSpan("ghost", 0.0, 1.0)], names, TIMES)


def test_acts_of_a_recording_are_its_interactions():
    recording = carrying(2.0, carried=(("box_1", "left", 0.4, 0.8), ("box_2", "right", 1.2, 1.6)))
    assert listed(true_spans(recording, 0.1)) == [("box_1", 0.4 - 0.1, 0.8 + 0.1), ("box_2", 1.2 - 0.1, 1.6 + 0.1)]


def test_interactions_with_what_is_not_known_tell_nothing():
    recording = carrying()
    nameless = replace(recording.interactions, objects=("",))
    assert true_spans(replace(recording, interactions=nameless)) == []


def test_interactions_need_not_be_in_order():
    carried_two = carrying(2.0, carried=(("box_1", "left", 1.2, 1.6), ("box_2", "right", 0.4, 0.8)))
    assert [span.object for span in true_spans(carried_two, 0.1)] == ["box_2", "box_1"]
    assert isinstance(carried_two.interactions, Interactions)


def test_a_single_object_without_interactions_is_active_throughout():
    recording = replace(carrying(), interactions=None)
    spans = true_spans(recording)
    assert (active_at(spans, ["box_1"], recording.motion.timestamps) == 0).all()


def test_several_objects_without_interactions_are_refused():
    recording = carrying(carried=(("box_1", "left", 0.4, 0.8), ("box_2", "right", 1.2, 1.6)))
    with pytest.raises(WearcapError, match="carry: 2 objects and no interactions.*Expected interactions"):
        true_spans(replace(recording, interactions=None))


def test_without_objects_there_is_nothing_to_do():
    assert true_spans(carrying(carried=())) == []
