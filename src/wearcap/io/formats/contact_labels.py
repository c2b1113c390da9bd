"""Annotated hand contacts: H-contact's JSON, and wearcap's extension of it by objects, classes and the recording.

H-contact: `{"contacts": {"left_hand": [[start, end], …], "right_hand": […]}}` in seconds on the motion's clock; a
label with end < start lasts until the recording ends. wearcap's own files add `objects` and `classes` (one entry per label,
"" where unknown) and the `recording` that the labels were made for.
"""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float64
from torch import Tensor

from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.recording.motion import HANDS, Interactions
from wearcap.scene.objects import CONTACT_CLASSES

SCHEMA = 1
SLACK_S = 0.05
"""Largest time (s) that a label may exceed the recording: a video's and a suit's clocks seldom end together."""


@dataclass(frozen=True)
class LabelClock:
    """The recording that labels belong to, and its span on its own clock (s)."""

    name: str
    frames: int
    start_s: float
    stop_s: float
    """One frame after the last one, so that a contact that never ends holds the last frame too."""

    @classmethod
    def of(cls, name: str, timestamps: Float64[Tensor, "time"]) -> "LabelClock":
        """Raises WearcapError for fewer than two frames."""
        if len(timestamps) < 2:
            raise WearcapError(f"a motion of {len(timestamps)} frames", name, "at least two to label")
        step = timestamps.diff().median().item()
        return cls(name, len(timestamps), timestamps[0].item(), timestamps[-1].item() + step)


@dataclass(frozen=True)
class Label:
    """One contact of one hand: start ≤ t < stop (s)."""

    start_s: float
    stop_s: float
    object: str = ""
    contact_class: str = ""


Labels = dict[str, tuple[Label, ...]]
"""Per hand of `HANDS`: labels in order, which do not overlap."""


def read_contact_labels(path: str | Path, clock: LabelClock) -> Interactions:
    """Contacts that H-contact, `wearcap annotate` or its export wrote.

    Raises WearcapError when the file is damaged or belongs to another recording, and for labels that are empty,
    overlap, or lie outside the recording.
    """
    return interactions_of(parse_labels(read_json(path), clock, where=path))


def hcontact_text(labels: Labels, clock: LabelClock) -> str:
    """H-contact's JSON: hands and times alone."""
    return json.dumps({"contacts": annotation_of(labels, clock)["contacts"]}, indent=1) + "\n"


def annotation_of(labels: Labels, clock: LabelClock) -> dict[str, Any]:
    """wearcap's own file: H-contact's content with objects, classes and the recording that the labels belong to."""
    about = {"name": clock.name, "frames": clock.frames, "start_s": clock.start_s, "stop_s": clock.stop_s}
    of_hands = {f"{hand}_hand": labels[hand] for hand in HANDS}

    def span(label: Label) -> list[float]:
        """A label that reaches the recording's end is written with end < start."""
        whole = label.stop_s >= clock.stop_s
        return [label.start_s, min(-1.0, label.start_s - 1.0) if whole else label.stop_s]

    return {
        "schema_version": SCHEMA,
        "recording": about,
        "contacts": {hand: [span(label) for label in found] for hand, found in of_hands.items()},
        "objects": {hand: [label.object for label in found] for hand, found in of_hands.items()},
        "classes": {hand: [label.contact_class for label in found] for hand, found in of_hands.items()},
    }


def parse_labels(content: Any, clock: LabelClock, *, where: str | Path) -> Labels:
    """Labels of a label file's content; errors name `where`. Raises WearcapError as `read_contact_labels`."""
    contacts = content.get("contacts") if isinstance(content, dict) else None
    names = [f"{hand}_hand" for hand in HANDS]
    if not isinstance(contacts, dict) or not all(isinstance(contacts.get(name), list) for name in names):
        expected = '{"contacts": {"left_hand": [[start, end], …], "right_hand": […]}} in seconds'
        raise WearcapError("no contact labels", where, expected)
    if "recording" in content:
        if content.get("schema_version") != SCHEMA:
            raise WearcapError(f"schema version {content.get('schema_version')}", where, f"version {SCHEMA}")
        with understood("does not name the recording of its labels", where):
            about = content["recording"]
            name, frames, span = about["name"], about["frames"], (about["start_s"], about["stop_s"])
            same = all(abs(a - b) < 1e-3 for a, b in zip(span, (clock.start_s, clock.stop_s)))
        if name != clock.name or frames != clock.frames or not same:
            what = f"labels of recording {name!r} with {frames} frames from {span[0]:.3f} to {span[1]:.3f} s"
            expected = f"{clock.name!r} with {clock.frames} frames from {clock.start_s:.3f} to {clock.stop_s:.3f} s"
            raise WearcapError(what, where, expected, "Give another output folder, or move this file away.")
    labels: Labels = {}
    for hand, name in zip(HANDS, names):
        pairs = contacts[name]
        beside = []  # one text per label; empty if the file has none
        for key in ("objects", "classes"):
            texts = content.get(key, {})
            texts = texts.get(name, [""] * len(pairs)) if isinstance(texts, dict) else None
            plain = isinstance(texts, list) and all(isinstance(text, str) for text in texts)
            if not plain or len(texts) != len(pairs):
                raise WearcapError(f"{key} of {name} do not match its labels", where, f"{len(pairs)} texts")
            beside.append(texts)
        objects, classes = beside
        if unknown := set(classes) - {"", *CONTACT_CLASSES}:
            raise WearcapError(f"class {unknown.pop()!r} in {name}", where, f"one of {', '.join(CONTACT_CLASSES)}")
        spans = [_span(pair, clock, f"{name} label {place}", where) for place, pair in enumerate(pairs)]
        found = [Label(*span, item, kind) for span, item, kind in zip(spans, objects, classes)]
        labels[hand] = tuple(sorted(found, key=lambda label: label.start_s))
        _refuse_overlap(labels[hand], clock, name, where)
    return labels


def _span(pair: Any, clock: LabelClock, label: str, where: str | Path) -> tuple[float, float]:
    """Start and stop of a label within the recording; end < start lasts until its end."""
    numbers = isinstance(pair, list) and len(pair) == 2 and all(type(value) in (int, float) for value in pair)
    if not numbers or not all(math.isfinite(value) for value in pair):
        raise WearcapError(f"{label} is {pair!r}"[:200], where, "[start, end] in seconds")
    start, end = pair
    if start == end:
        fix = "Delete the label, or write an end before its start where it lasts to the end."
        raise WearcapError(f"{label} is empty: {start} to {end} s", where, "an end after the start", fix)
    stop = clock.stop_s if end < start else end
    if not (clock.start_s - SLACK_S <= start < clock.stop_s - 1e-9 and clock.start_s < stop <= clock.stop_s + SLACK_S):
        what = f"{label} from {start} to {end} s is outside the recording"
        expected = f"times from {clock.start_s:.3f} to {clock.stop_s:.3f} s"
        raise WearcapError(what, where, expected, "Is it the file of another recording?")
    return max(float(start), clock.start_s), min(float(stop), clock.stop_s)


def _refuse_overlap(labels: Sequence[Label], clock: LabelClock, name: str, where: str | Path) -> None:
    for label, following in itertools.pairwise(labels):
        if following.start_s < label.stop_s:
            until = "to the end of the recording" if label.stop_s == clock.stop_s else f"to {label.stop_s} s"
            what = f"labels of {name} overlap: one from {label.start_s} {until}, the next from {following.start_s} s"
            fix = "Give the first an end before the second starts (an end before its start means: until the end)."
            raise WearcapError(what, where, "one contact of a hand at a time", fix)


def interactions_of(labels: Labels) -> Interactions:
    """Labels as interactions: hands on the same named object share one; a new one starts when the hands change."""
    found: list[tuple[float, float, tuple[bool, ...], str, str]] = []
    for item in {(label.object, label.contact_class) for hand in HANDS for label in labels[hand]}:
        by_hand = [[label for label in labels[hand] if (label.object, label.contact_class) == item] for hand in HANDS]
        if not item[0]:  # two hands on unknown objects need not hold the same one
            for number, spans in enumerate(by_hand):
                one = tuple(other == number for other in range(len(HANDS)))
                found += [(label.start_s, label.stop_s, one, *item) for label in spans]
            continue
        edges = sorted({edge for spans in by_hand for label in spans for edge in (label.start_s, label.stop_s)})
        for start, stop in itertools.pairwise(edges):
            hands = tuple(any(s.start_s <= start < s.stop_s for s in spans) for spans in by_hand)
            if any(hands):
                found.append((start, stop, hands, *item))
    found.sort(key=lambda row: row[0])
    return Interactions.of(found)


def labels_of(interactions: Interactions, clock: LabelClock) -> Labels:
    """Each hand's labels; adjacent intervals on the same named object become one.

    Raises WearcapError where a hand would hold two objects at once, or outside the recording.
    """
    labels: Labels = {}
    rows = sorted(interactions.rows, key=lambda row: row[0])
    for number, hand in enumerate(HANDS):
        joined: list[Label] = []
        for start, stop, hands, item, kind in rows:
            if not hands[number]:
                continue
            span = _span([start, stop], clock, f"{hand}_hand's interaction", clock.name)
            label = Label(*span, item, kind)
            last = joined[-1] if joined else None
            if last and item and (last.stop_s, last.object, last.contact_class) == (span[0], item, kind):
                joined[-1] = replace(last, stop_s=span[1])
            else:
                joined.append(label)
        labels[hand] = tuple(joined)
        _refuse_overlap(labels[hand], clock, f"{hand}_hand", clock.name)
    return labels
