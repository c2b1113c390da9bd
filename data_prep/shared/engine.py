"""One recording per task, through joblib: parallel, resumable, and the same bytes however it is run.

A worker writes its recording's file; the parent enters it in the manifest as results arrive. Killed at any
moment, a data set is left with whole files and a whole manifest, and the next run does only what is missing.
"""

import csv
import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numba
import torch

from wearcap.boundary.opening import file_size, understood
from wearcap.boundary.texts import numbered_lines
from wearcap.errors import WearcapError
from wearcap.files import remove_leftovers, sha256_of
from wearcap.io.formats.poses import are_rotations
from wearcap.locks import folder_lock
from wearcap.parallel import Parallel, progress_bar, reason_of
from wearcap.prepare.files import with_own_files
from wearcap.recording.recording import MIN_DURATION_S, Recording
from wearcap.recording.serialize import flatten
from wearcap.recording.store import SPLITS, Entry, RecordingStore, recording_path, save_recording

REGISTER_EVERY_S = 1.0
"""Least interval (s) between writes of the manifest: a large data set's has megabytes."""

BY_HASH = "hash"
"""Split of a pattern's subjects by the hash of their names: 5 % val, 15 % test, the others train."""
NOTE = "note"
"""Key of a motion's provenance that the report repeats: notes on cut, dropped or guessed data."""


@dataclass(frozen=True)
class Task:
    """One recording to make. `make` must be picklable and deterministic."""

    name: str
    make: Callable[[], Recording]
    split: str
    hash: str
    """Hash that changes when the source's bytes or the settings change."""


@dataclass(frozen=True)
class Report:
    """Result of a run, by recording name."""

    written: list[str] = field(default_factory=list)
    current: list[str] = field(default_factory=list)
    """Recordings left unchanged: their hash is current and their file complete."""
    failed: dict[str, str] = field(default_factory=dict)
    """Reasons of failed recordings by name."""
    notes: dict[str, str] = field(default_factory=dict)


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
        fix = "Add a row with it, or a last row such as '*,train'."
        raise WearcapError(f"subject {subject!r} is in no split", where=self.path, fix=fix)

    @classmethod
    def read(cls, path: str | Path) -> "Splits":
        """Read a list with columns `subject,split`; lines that begin with # are comments.

        A subject may be a pattern (`HumanEva/*`), a split is train, val, test, or "hash".
        """
        path = Path(path)
        file_size(path, "split list")
        lines = (line for _, line in numbered_lines(path, "table") if line.strip() and not line.startswith("#"))
        with understood("not a split list", path, "columns subject,split", errors=csv.Error):
            table = list(csv.DictReader(lines))
        if not table or set(table[0]) != {"subject", "split"}:
            raise WearcapError("not a split list", where=path, expected="columns subject,split")
        for row in table:
            if row["split"] not in (*SPLITS, BY_HASH):
                expected = f"one of {', '.join((*SPLITS, BY_HASH))}"
                raise WearcapError(f"no split {row['split']!r}", where=path, expected=expected)
        return cls(path, tuple((row["subject"], row["split"]) for row in table))


def source_folder(source: str | Path) -> Path:
    """The folder of a source's files. Raises WearcapError if it does not exist."""
    if not Path(source).is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    return Path(source)


def changed(read: Callable[[], Recording], **changes: Any) -> Recording:
    """The recording that `read` returns, with fields replaced; a partial of it is a task's `make`."""
    return replace(read(), **changes)


def prepare(
    tasks: list[Task],
    output: str | Path,
    *,
    jobs: int = -1,
    backend: str = "loky",
    scheduler: str | None = None,
    overwrite: bool = False,
    inspect: Callable[[Recording], None] | None = None,
) -> Report:
    """Make every recording that is missing or out of date; `inspect` (picklable) raises WearcapError for a bad one.

    `jobs` is joblib's (-1: all cores); with backend "dask" and no `scheduler` address, that many local workers.
    A recording that cannot be made is reported, and the others continue. Raises WearcapError when the output cannot be
    written at all or another run writes there, and for an unknown backend or two tasks of one name.
    """
    if not tasks:
        raise WearcapError("nothing to prepare", fix="Check the source folder and its settings.")
    names = {task.name for task in tasks}
    if len(names) < len(tasks):
        twice = Counter(task.name for task in tasks).most_common(1)[0][0]
        raise WearcapError(f"two sources give a recording the name {twice!r}", expected="unique names")
    parallel = Parallel(jobs, backend, scheduler)
    with folder_lock(output, "prepare") as lock:
        store = RecordingStore(output)
        store.register({})  # missing permission or space should show now and not after the first hour
        remove_leftovers(store.root, below=True)
        todo = tasks if overwrite else [task for task in tasks if not _is_current(store, task)]
        report = Report(current=sorted(names - {task.name for task in todo}))
        outcomes = parallel.run(partial(_run, root=store.root, inspect=inspect), todo, store.root, lock)
        with closing(outcomes), registering(store, len(tasks), len(report.current)) as finish:
            for name, outcome, note in outcomes:
                made = {name: outcome} if isinstance(outcome, Entry) else {}
                if isinstance(outcome, Entry):
                    report.written.append(name)
                else:
                    report.failed[name] = outcome
                    store.entries.pop(name, None)  # made with other settings
                if note:
                    report.notes[name] = note
                finish(made)
    report.written.sort()
    return report


def _is_current(store: RecordingStore, task: Task) -> bool:
    entry = store.entries.get(task.name)
    if entry is None or (entry.config_hash, entry.split) != (task.hash, task.split):
        return False
    path = store.root / entry.file
    return path.is_file() and path.stat().st_size == entry.bytes and sha256_of(path) == entry.sha256


def _run(task: Task, root: Path, inspect: Callable[[Recording], None] | None = None) -> tuple[str, Entry | str, str]:
    """In a worker: make, check and write one recording; returns (name, entry or reason of failure, note)."""
    threads = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)  # recordings are the unit of parallelism, and sums over threads differ in their last bits
    numba.set_num_threads(1)
    try:
        try:
            recording = task.make()
            if recording.name != task.name:
                raise WearcapError(f"the source made a recording {recording.name!r}", expected=task.name)
            check_recording(recording)
            if inspect is not None:
                inspect(recording)
            recording = with_own_files(recording, root, root)
        except Exception as error:
            return task.name, reason_of(error), ""
        save_recording(recording, recording_path(root, task.name))
        note = recording.note or (recording.motion.provenance.get(NOTE, "") if recording.motion else "")
        return task.name, Entry.of(recording, root, task.split, task.hash), note
    finally:
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])


@contextmanager
def registering(store: RecordingStore, total: int, done: int = 0) -> Iterator[Callable[[dict[str, Entry]], None]]:
    """Show progress, and enter recordings in the manifest at most every `REGISTER_EVERY_S`, and at the end.

    The yielded function is called for each finished recording, with its entry if it has been written.
    """
    pending, written_at = dict[str, Entry](), time.monotonic()

    def finish(made: dict[str, Entry]) -> None:
        nonlocal written_at
        pending.update(made)
        if time.monotonic() - written_at > REGISTER_EVERY_S:
            store.register(pending)
            pending.clear()
            written_at = time.monotonic()
        advance()

    try:
        with progress_bar(total, done) as advance:
            yield finish
    finally:
        store.register(pending)


RATES_HZ = (1.0, 2000.0)
ORTHOGONAL_WITHIN = 1e-3
MAY_BE_UNKNOWN = ("localization.", "cues.")
"""Streams whose frames without a measurement may hold NaN beside a confidence of 0."""


def check_recording(recording: Recording) -> None:
    """Raise WearcapError when numbers are not finite, timestamps do not rise, or rotations are invalid.

    Every stream needs rising timestamps; `motion` and `head` a plausible rate and at least `MIN_DURATION_S`.
    """
    where = recording.name
    _, tensors = flatten(recording)
    for key, tensor in tensors.items():
        known = not key.startswith(MAY_BE_UNKNOWN)
        if known and tensor.is_floating_point() and (bad := ~torch.isfinite(tensor)).any():
            row = int(bad.reshape(len(bad), -1).any(1).nonzero()[0])
            wrong = f"{int(bad.sum())} values of {key} are not finite, the first in row {row}"
            raise WearcapError(wrong, where=where, expected="numbers", fix="Mend or drop the source.")
        if key.endswith("timestamps") and len(still := (tensor.diff() <= 0).nonzero()):
            wrong = f"{key} do not rise at row {int(still[0]) + 1} (frame rate 0?)"
            raise WearcapError(wrong, where=where, expected="strictly rising seconds")
        if known and key.rpartition(".")[2].startswith("R_"):
            bad = ~are_rotations(tensor.double().reshape(-1, 3, 3), ORTHOGONAL_WITHIN)
            if bad.any():
                wrong = f"{int(bad.sum())} matrices of {key} are no rotations"
                expected = f"orthogonal within {ORTHOGONAL_WITHIN}, determinant +1"
                raise WearcapError(wrong, where=where, expected=expected)
    for part in ("motion", "suit", "head"):
        times = tensors.get(f"{part}.timestamps")
        if times is None:
            continue
        if len(times) < 2 or (duration := (times[-1] - times[0]).item()) < MIN_DURATION_S:
            expected = f"at least {MIN_DURATION_S} s of motion"
            raise WearcapError(f"{part} has {len(times)} frames", where=where, expected=expected)
        fps = (len(times) - 1) / duration
        if not RATES_HZ[0] <= fps <= RATES_HZ[1]:
            what = f"{part} runs at {fps:.4g} frames per second"
            fix = "Give the true frame rate of the source."
            raise WearcapError(what, where=where, expected=f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g}", fix=fix)
    if recording.motion is None and recording.suit is None and recording.head is None:
        raise WearcapError("no motion, no suit and no head path", where=where, expected="one at least")
