"""One recording's labels on disk: written atomically, never over other content, with backups of earlier states."""

import hashlib
import json
import threading
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.io.formats.contact_labels import LabelClock, Labels, annotation_of, parse_labels
from wearcap.io.formats.text import read_json


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
                self._back_up(there)
            write_text(self.path, text)
            self._writer = (client, new)
            self._ours.add(new)
            return new

    def _revision(self) -> str:
        try:
            return _digest(self.path.read_bytes())
        except FileNotFoundError:
            return ""

    def _back_up(self, revision: str) -> None:
        copy = self.path.parent / "backups" / f"{self.clock.name}.{revision}.contacts.json"
        if not copy.exists():
            with atomic_path(copy) as temporary:
                temporary.write_bytes(self.path.read_bytes())


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]
