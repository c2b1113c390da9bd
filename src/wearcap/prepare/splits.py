"""Committed split lists: which subject belongs to training, validation or test."""

import csv
import hashlib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.recording.store import SPLITS

BY_HASH = "hash"
"""Split of a pattern's subjects by the hash of their names: 5 % val, 15 % test, the others train."""


@dataclass(frozen=True)
class Splits:
    """Rows (subject or pattern, split) of a list; the first row that matches a subject decides."""

    path: Path
    rows: tuple[tuple[str, str], ...]

    def of(self, subject: str) -> str:
        """Split of a subject. Raises WearcapError when no row matches."""
        for pattern, split in self.rows:
            if fnmatchcase(subject, pattern):
                if split != BY_HASH:
                    return split
                share = int.from_bytes(hashlib.sha256(subject.encode()).digest()[:4], "big") / 2**32
                return "val" if share < 0.05 else "test" if share < 0.20 else "train"
        raise WearcapError(
            f"subject {subject!r} is in no split",
            where=self.path,
            fix="Add a row with it, or a last row such as '*,train'.",
        )

    @classmethod
    def read(cls, path: str | Path) -> "Splits":
        """Read a list with columns `subject,split`; lines that begin with # are comments.

        A subject may be a pattern (`HumanEva/*`), a split is train, val, test, or "hash".
        """
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError as error:
            raise WearcapError(
                "no such split list", where=path, expected="a .csv with columns subject,split"
            ) from error
        table = list(csv.DictReader(line for line in lines if line.strip() and not line.startswith("#")))
        if not table or set(table[0]) != {"subject", "split"}:
            raise WearcapError("not a split list", where=path, expected="columns subject,split")
        for row in table:
            if row["split"] not in (*SPLITS, BY_HASH):
                raise WearcapError(
                    f"no split {row['split']!r}", where=path, expected=f"one of {', '.join((*SPLITS, BY_HASH))}"
                )
        return cls(path, tuple((row["subject"], row["split"]) for row in table))
