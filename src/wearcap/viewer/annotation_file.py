"""One recording's labels on disk: written atomically, never over other content, with backups; and labels to start from."""

import hashlib
import json
import threading
from pathlib import Path
from typing import Any

import torch

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.io.formats.contact_labels import LabelClock, Labels, annotation_of, labels_of, parse_labels
from wearcap.io.formats.motion_npz import read_motion
from wearcap.io.formats.text import read_json
from wearcap.recording.interactions import HANDS, Interactions
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.systems.ireplica.contact_intervals import ContactSettings, active, contact_intervals


def label_path(output: str | Path, name: str) -> Path:
    """OUTPUT/<recording>.contacts.json. Raises WearcapError for a name that is no plain file name."""
    if not name or Path(name).name != name or name.startswith("."):
        raise WearcapError(f"{name!r} cannot name a file of labels", expected="a plain file name")
    return Path(output) / f"{name}.contacts.json"


class Conflict(WearcapError):
    """Raised if the file is not the one that the labels were made from."""


class AnnotationFile:
    """The file at `label_path`. Each of its states has a revision; "" if there is no file."""

    def __init__(self, output: str | Path, clock: LabelClock):
        self.path, self.clock = label_path(output, clock.name), clock
        self._lock = threading.Lock()
        self._writer = ("", "")
        self._ours: set[str] = set()

    def read(self) -> tuple[Labels, str]:
        """Labels and their revision. Raises WearcapError when the file is damaged or of another recording."""
        with self._lock:
            revision = self._revision()
            if not revision:
                return parse_labels({"contacts": {"left_hand": [], "right_hand": []}}, self.clock, where=self.path), ""
            return parse_labels(read_json(self.path), self.clock, where=self.path), revision

    def save(self, content: Any, base: str, *, client: str = "", force: bool = False) -> str:
        """Write labels (as `annotation_of` makes them) that were made from revision `base`, and return theirs.

        A state that was not written by this session is copied to `backups/` first. Raises WearcapError for
        impossible labels, and Conflict when the file has changed since `base` by another than `client`, unless
        forced.
        """
        labels = parse_labels(content, self.clock, where="labels")
        text = json.dumps(annotation_of(labels, self.clock), indent=1, ensure_ascii=False) + "\n"
        with self._lock:
            there = self._revision()
            new = _digest(text.encode())
            if there == new:
                return new
            if not (force or there == base or (there and self._writer == (client, there))):
                raise Conflict(
                    "the labels on disk were changed by another window or program",
                    where=self.path,
                    expected="the state that this page loaded or saved last",
                )
            if there and there not in self._ours:
                copy = self.path.parent / "backups" / f"{self.clock.name}.{there}.contacts.json"
                if not copy.exists():
                    with atomic_path(copy) as temporary:
                        temporary.write_bytes(self.path.read_bytes())
            write_text(self.path, text)
            self._writer = (client, new)
            self._ours.add(new)
            return new

    def _revision(self) -> str:
        try:
            return _digest(self.path.read_bytes())
        except FileNotFoundError:
            return ""


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def starting_labels(source: str | Path, recording: Recording, clock: LabelClock) -> Labels:
    """Labels of a label file (.json), of a captured motion (.npz), or for "recording" the recording's own.

    Raises WearcapError if the source has no contacts, or impossible ones.
    """
    if str(source) == "recording":
        if recording.interactions is None:
            raise WearcapError(
                "no interactions to start from",
                where=recording.name,
                expected="a recording that has them",
                fix="Start from a label file (.json), from a captured motion (.npz), or from nothing.",
            )
        return labels_of(recording.interactions, clock)
    if Path(source).suffix == ".json":
        return parse_labels(read_json(source), clock, where=source)
    motion = read_motion(source)
    found = motion.interactions or _predicted(motion)
    if found is None:
        raise WearcapError(
            "a motion without contacts of the hands",
            where=source,
            expected="one that a pipeline with a contact network captured",
        )
    return labels_of(found, clock)


def _predicted(motion: Motion) -> Interactions | None:
    """Contacts of each hand by itself, from probabilities with short gaps filled."""
    prob = motion.hand_contact_prob
    if prob is None:
        return None
    if prob.shape != (len(motion), len(HANDS)):
        raise WearcapError(f"hand contacts of shape {tuple(prob.shape)}", expected=f"({len(motion)}, {len(HANDS)})")
    contact = active(prob, motion.timestamps, ContactSettings())
    # Start times of frames, and the end of the last.
    edges = torch.cat([motion.timestamps, motion.timestamps[-1:] + motion.timestamps.diff().median()])
    spans, hands = [], []
    for hand in range(len(HANDS)):
        alone = contact & (torch.arange(len(HANDS)) == hand)
        for held in contact_intervals(alone):
            spans.append((edges[held.start].item(), edges[held.stop].item()))
            hands.append(held.hands)
    table = torch.tensor(spans, dtype=torch.float64).reshape(-1, 2)
    which = torch.tensor(hands, dtype=torch.bool).reshape(-1, len(HANDS))
    return Interactions(table[:, 0], table[:, 1], which, ("",) * len(spans), ("",) * len(spans))
