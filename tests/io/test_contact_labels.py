"""Contact labels: round trips through H-contact's JSON and our own, and files with impossible contents."""

import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from wearcap.errors import WearcapError
from wearcap.io.formats.contact_labels import (
    Label,
    LabelClock,
    annotation_of,
    hcontact_text,
    interactions_of,
    labels_of,
    parse_labels,
    read_contact_labels,
)
from wearcap.recording.motion import Interactions

TIMES = torch.arange(600, dtype=torch.float64) / 60
CLOCK = LabelClock.of("flat_1", TIMES)


def contacts(left=(), right=(), **more) -> dict:
    return {"contacts": {"left_hand": [list(p) for p in left], "right_hand": [list(p) for p in right]}} | more


def parsed(content: dict):
    return parse_labels(content, CLOCK, where="labels.json")


def test_hcontact_is_read(tmp_path):
    path = tmp_path / "seq.json"
    path.write_text(json.dumps(contacts([[4.0, 5.0], [1.0, 2.5]], [[9.0, 0.0]])))
    found = read_contact_labels(path, CLOCK)
    assert found.start_s.tolist() == [1.0, 4.0, 9.0]
    assert found.hands.tolist() == [[True, False], [True, False], [False, True]]
    contact = found.hand_contact(TIMES)
    assert contact[60:150, 0].all()
    assert not contact[150:240, 0].any()
    assert contact[540:, 1].all()
    assert contact[-1, 1], "a label that is open at its end holds the last frame"
    (tmp_path / "out.json").write_text(hcontact_text(labels_of(found, CLOCK), CLOCK))
    assert json.loads((tmp_path / "out.json").read_text()) == contacts([[1.0, 2.5], [4.0, 5.0]], [[9.0, -1.0]])


def test_two_hands_at_one_object_are_one_interaction():
    both = Interactions(
        torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64),
        torch.tensor([2.0, 3.0, 4.0], dtype=torch.float64),
        torch.tensor([[True, False], [True, True], [False, True]]),
        ("sofa",) * 3,
        ("sliding",) * 3,
    )
    labels = labels_of(both, CLOCK)
    assert labels == {"left": (Label(1.0, 3.0, "sofa", "sliding"),), "right": (Label(2.0, 4.0, "sofa", "sliding"),)}
    back = interactions_of(labels)
    for name in ("start_s", "stop_s", "hands"):
        assert torch.equal(getattr(back, name), getattr(both, name))
    assert (back.objects, back.classes) == (both.objects, both.classes)


@st.composite
def any_labels(draw):
    labels = {}
    for hand in ("left", "right"):
        edges = sorted(draw(st.sets(st.integers(0, 600), max_size=12)))
        spans = list(zip(edges[::2], edges[1::2]))
        labelled = [draw(st.sampled_from([("", ""), ("sofa", "sliding"), ("door", "hinged")])) for _ in spans]
        labels[hand] = tuple(
            Label(TIMES[a].item(), TIMES[b].item() if b < 600 else CLOCK.stop_s, *label_of)
            for (a, b), label_of in zip(spans, labelled)
        )
    return labels


@given(any_labels())
def test_every_frame_keeps_its_label_through_files_and_interactions(labels):
    text = json.dumps(annotation_of(labels, CLOCK))
    assert parsed(json.loads(text)) == labels
    assert labels_of(interactions_of(labels), CLOCK) == labels
    bare = parsed(json.loads(hcontact_text(labels, CLOCK)))
    wanted, found = (interactions_of(each).hand_contact(TIMES) for each in (labels, bare))
    assert torch.equal(wanted, found)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "no contact labels"),
        ({"contacts": {"left_hand": []}}, "no contact labels"),
        (contacts([[1, 3], [2, 4]]), "overlap: one from 1.0 to 3.0 s, the next from 2.0 s"),
        (contacts([[3, 1], [5, 6]]), "overlap: one from 3.0 to the end of the recording"),
        (contacts([[2, 2]]), "left_hand label 0 is empty"),
        (contacts((), [[8, 11]]), "right_hand label 0 from 8 to 11 s is outside the recording"),
        (contacts([[-3, 1]]), "outside"),
        (contacts([[11, 1]]), "outside"),
        (contacts([[1, "2"]]), "expected|Expected"),
        (contacts([[1]]), "start, end"),
        (contacts([[1, True]]), "start, end"),
        (contacts([[1, 1e400]]), "start, end"),
        (contacts([[1, 2]], objects={"left_hand": []}), "objects of left_hand"),
        (contacts([[1, 2]], classes={"left_hand": ["floating"]}), "class 'floating'"),
        (contacts(recording={"name": "flat_1"}), "schema version None"),
        (contacts(recording={"name": "flat_1"}, schema_version=1), "does not name the recording"),
        (contacts(recording=3, schema_version=1), "does not name the recording"),
    ],
)
def test_impossible_labels_are_refused(content, message):
    with pytest.raises(WearcapError, match=message) as raised:
        parsed(content)
    assert str(raised.value).startswith("labels.json: ")


def test_an_annotation_of_another_recording_is_refused():
    labels = {"left": (Label(1.0, 2.0),), "right": ()}
    for other in (
        LabelClock.of("flat_2", TIMES),
        LabelClock.of("flat_1", TIMES + 3.0),
        LabelClock.of("flat_1", TIMES[1:]),
    ):
        with pytest.raises(WearcapError, match=f"labels of recording '{other.name}' with {other.frames} frames"):
            parsed(annotation_of(labels, other))
    assert parsed(annotation_of(labels, CLOCK)) == labels


def test_labels_a_little_outside_are_cut():
    assert parsed(contacts([[-0.03, 1.0]], [[9.0, 10.04]])) == {
        "left": (Label(0.0, 1.0),),
        "right": (Label(9.0, CLOCK.stop_s),),
    }


def test_a_hand_holds_one_thing_at_a_time():
    two = Interactions(
        torch.tensor([1.0, 2.0], dtype=torch.float64),
        torch.tensor([3.0, 4.0], dtype=torch.float64),
        torch.tensor([[True, False], [True, False]]),
        ("sofa", "door"),
        ("sliding", "hinged"),
    )
    with pytest.raises(WearcapError, match="flat_1: labels of left_hand overlap"):
        labels_of(two, CLOCK)
    with pytest.raises(WearcapError, match="at least two"):
        LabelClock.of("still", TIMES[:1])


def test_damaged_files(tmp_path):
    with pytest.raises(WearcapError):
        read_contact_labels(tmp_path / "none.json", CLOCK)
    (tmp_path / "cut.json").write_text('{"contacts": {"left_')
    with pytest.raises(WearcapError, match="JSON"):
        read_contact_labels(tmp_path / "cut.json", CLOCK)
