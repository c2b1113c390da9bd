"""Whole data sets: recordings are spread over processes, finished ones kept, failed ones listed; one table at the end.

A note per finished recording holds a key of its inputs, of the checkpoint, of the config and of the code; while the key
is the same, the recording is not processed again.
"""

import csv
import io
import json
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from rich.markup import escape
from rich.table import Table

from wearcap.boundary.texts import read_json
from wearcap.checks import require_sound
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import Measure, evaluate
from wearcap.evaluation.samples import Spread
from wearcap.files import remembered_sha256, write_text
from wearcap.io.formats.scene_folder import cloud_file, used_files
from wearcap.locks import folder_lock
from wearcap.metrics.table import TRUTH, Row, decimals
from wearcap.models.checkpoint import checkpoint_file, shared_checkpoints
from wearcap.parallel import Parallel, divided, progress_bar, reason_of
from wearcap.recording import RecordingStore
from wearcap.runtime.stages import code_digest, digest
from wearcap.runtime.system import StageOptions, System
from wearcap.version import __version__

SHOWN = 3
"""Metrics of a table of recordings; its file has them all."""


@dataclass(frozen=True)
class Outcome:
    """What became of one recording."""

    recording: str
    seconds: float = 0.0
    frames: int = 0
    rows: tuple[Row, ...] = ()
    """Scores by seed; none without ground truth."""
    files: tuple[tuple[str, int], ...] = ()
    """Files that were written, with their sizes (bytes)."""
    error: str = ""
    """Why it failed; "" if it did not."""
    activity: str = ""
    """What was done in it."""

    def scores(self) -> dict[str, float]:
        """Means over seeds by metric."""
        names = self.rows[0].scores if self.rows else ()
        return {name: sum(row.scores[name] for row in self.rows) / len(self.rows) for name in names}


Work = Callable[[Sequence[str]], list[Outcome]]
"""Processes some recordings, by name, in one go. It must be picklable for several processes."""


def over_recordings(
    work: Work,
    store: RecordingStore,
    names: Sequence[str],
    how: Parallel,
    *,
    chunk: int = 1,
    notes: Path | None = None,
    settings: str = "",
    scene: str | Path | None = None,
    overwrite: bool = False,
) -> Iterator[Outcome]:
    """One outcome per recording, as they are finished; `chunk` recordings are processed at a time.

    `notes`: folder of the finished recordings' notes, and the key's `settings`; None: nothing is kept. `scene` replaces
    the recordings' own. If a chunk fails, its recordings are processed one by one. Raises WearcapError when another run
    writes there, or a worker was killed.
    """
    todo: list[tuple[str, str]] = []
    locked = nullcontext() if notes is None else folder_lock(notes, "capture or evaluation")
    with locked as lock, progress_bar(len(names), transient=True) as done:
        for name in names:
            try:
                key = "" if notes is None else digest(settings, *_inputs(store, name, scene))
            except WearcapError as error:
                yield Outcome(name, error=reason_of(error))
                done()
                continue
            kept = None if notes is None or overwrite else _kept(notes, name, key)
            if kept is None:
                todo.append((name, key))
            else:
                yield kept
                done()
        chunks = divided(todo, chunk)
        how = how if len(chunks) > 1 else Parallel(jobs=1)
        with closing(how.run(partial(_worked, work=work, notes=notes), chunks, store.root, lock)) as finished:
            for outcomes in finished:
                for outcome in outcomes:
                    yield outcome
                    done()


def _worked(part: Sequence[tuple[str, str]], work: Work, notes: Path | None) -> list[Outcome]:
    """In a worker: the outcomes of some recordings, with a note of each that is finished."""
    try:
        outcomes = work([name for name, _ in part])
    except Exception as error:
        if len(part) > 1:
            return [outcome for one in part for outcome in _worked([one], work, notes)]
        outcomes = [Outcome(part[0][0], error=reason_of(error))]
    keys = dict(part)
    for outcome in outcomes:
        if notes is not None and not outcome.error:
            write_text(notes / f"{outcome.recording}.json", _note(outcome, keys[outcome.recording]))
    return outcomes


def _note(outcome: Outcome, key: str) -> str:
    about = asdict(outcome)
    for row in about["rows"]:  # JSON has no NaN
        row["scores"] = {name: value if math.isfinite(value) else str(value) for name, value in row["scores"].items()}
    return json.dumps({"key": key} | about, indent=1, allow_nan=False) + "\n"


def _kept(notes: Path, name: str, key: str) -> Outcome | None:
    """The outcome of a recording's note, if it has the key and all files are there as they were written."""
    with suppress(OSError, LookupError, TypeError, ValueError, WearcapError):  # none, or a damaged one
        about = read_json(notes / f"{name}.json")
        outcome = msgspec.convert(about, Outcome, strict=False)  # texts are numbers, too: "nan"
        if about["key"] == key and all(Path(path).stat().st_size == size for path, size in outcome.files):
            return outcome
    return None


def _inputs(store: RecordingStore, name: str, scene: str | Path | None) -> list[str]:
    """Checksums of a recording and of the files that belong to it: its scan, map and objects, and its video.

    Raises WearcapError for a recording that cannot be read, and for a scene without a point cloud.
    """
    file = store.open_file(name)
    camera = file.part("camera")
    named = [file.part("scene") if scene is None else None, file.part("environment"), camera and camera.video]
    paths = [store.root / part for part in named if part] + ([] if scene is None else [cloud_file(scene)])
    files = dict.fromkeys(each for path in paths if path.is_file() for each in used_files(path))
    return [store.entries[name].sha256, *map(remembered_sha256, files)]


def settings_key(config: dict[str, Any], checkpoints: Sequence[str | Path], *modules: str) -> str:
    """Digest of settings, of the checkpoints and other files that they name, and of the code of what they build.

    `modules`: further ones whose code decides results.
    """
    values, targets = list(_values(config)), {*modules, "wearcap.evaluation.datasets"}
    for key, value in values:
        parts = str(value).split(".")
        if key == "_target_" and parts[0] == "wearcap":
            targets.add(".".join(part for part in parts[:-1] if not part[:1].isupper()))
    named = [value for key, value in values if isinstance(value, str) and key != "_target_"]
    shared = shared_checkpoints()
    files = [Path(value) for value in named if len(value) < 1000 and Path(value).is_file()]
    files += [checkpoint_file(value) for value in named if value in shared]
    used = [checkpoint_file(checkpoint) for checkpoint in checkpoints] + files
    sums = [remembered_sha256(path) for path in used]
    return digest(__version__, json.dumps(config, sort_keys=True), sums, code_digest(*targets))


def _values(config: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(config, dict):
        for name, value in config.items():
            yield from _values(value, str(name))
    elif isinstance(config, list):
        for value in config:
            yield from _values(value, key)
    else:
        yield key, config


_LOADED: dict[str, System] = {}
_LOADING = threading.Lock()


def loaded(key: str, make: Callable[[], System]) -> System:
    """The system of a key, made once in a process; the one of another key is let go."""
    with _LOADING:
        if key not in _LOADED:
            _LOADED.clear()
            _LOADED[key] = make()
        return _LOADED[key]


def scored(
    names: Sequence[str],
    *,
    system: Callable[[], System],
    key: str,
    root: Path,
    seeds: Sequence[int],
    batch_size: int,
    scene: str | Path | None = None,
    metres_per_unit: float | None = None,
    cache: Path | None = None,
    check: bool = False,
    measure: Measure | None = None,
    samples: bool = False,
) -> list[Outcome]:
    """Outcomes of some recordings that are captured with every seed and scored; seconds are shared out by frames. `samples`: the
    seeds' motions are scored by how far they are apart, too.

    Raises WearcapError as `evaluate` does, and with `check` for a recording in which the doctor finds an error.
    """
    store = RecordingStore.open(root)
    for name in names if check else ():
        require_sound(store.load(name))
    made = loaded(key, system)
    measure = Spread(measure or made.score) if samples else measure
    begin = time.perf_counter()
    found = evaluate(made, store, names, seeds, batch_size, measure, scene, metres_per_unit, StageOptions(cache))
    rows: dict[str, list[Row]] = {name: [] for name in names}
    for row in found:
        rows[row.recording].append(row)
    entries = [(name, store.entries[name]) for name in names]
    per_frame = (time.perf_counter() - begin) / max(1, sum(entry.frames for _, entry in entries))
    return [
        Outcome(
            name,
            per_frame * entry.frames,
            entry.frames,
            tuple(rows[name]),
            error="" if rows[name] else "no motion",
            activity=entry.context.activity,
        )
        for name, entry in entries
    ]


def failures(outcomes: Iterable[Outcome]) -> dict[str, str]:
    """Reasons of failed recordings by name."""
    return {outcome.recording: outcome.error for outcome in outcomes if outcome.error}


def require_all(outcomes: Sequence[Outcome], where: str | Path) -> None:
    """Raise WearcapError with the first reason when recordings have failed."""
    failed = failures(sorted(outcomes, key=lambda outcome: outcome.recording))
    if failed:
        name, reason = next(iter(failed.items()))
        what = f"{len(failed)} of {len(outcomes)} recordings failed, {name} among them: {reason}"
        raise WearcapError(what, where, fix="The same command does only these again.")


def outcome_table(title: str, outcomes: Iterable[Outcome]) -> Table:
    """A table for a terminal: recording, seconds, frames, its first metrics, error."""
    table, rows = Table(title=title), sorted(outcomes, key=lambda outcome: outcome.recording)
    metrics = [name for name in _metrics(rows) if not name.startswith(TRUTH)][:SHOWN]
    failed = bool(failures(rows))
    table.add_column("recording", no_wrap=True)
    for heading in ("seconds", "frames", *metrics):
        table.add_column(heading, justify="right")
    if failed:
        table.add_column("error", overflow="fold")
    for row in rows:
        scores = row.scores()
        values = [scores.get(name, math.nan) for name in metrics]
        cells = ["–" if math.isnan(value) else f"{value:.{decimals(value)}f}" for value in values]
        cells += [escape(row.error)] if failed else []
        table.add_row(escape(row.recording), f"{row.seconds:.1f}", str(row.frames), *cells)
    return table


def write_outcomes(path: str | Path, outcomes: Iterable[Outcome]) -> None:
    """Write that table with all metrics as CSV, atomically."""
    rows = sorted(outcomes, key=lambda outcome: outcome.recording)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    metrics = _metrics(rows)
    writer.writerow(["recording", "activity", "seconds", "frames", *metrics, "error"])
    for row in rows:
        scores = row.scores()
        cells = [scores.get(name, "") for name in metrics]
        writer.writerow([row.recording, row.activity, f"{row.seconds:.3f}", row.frames, *cells, row.error])
    write_text(path, text.getvalue())


def _metrics(outcomes: Iterable[Outcome]) -> list[str]:
    return list(dict.fromkeys(name for outcome in outcomes for row in outcome.rows[:1] for name in row.scores))


def rows_of(outcomes: Iterable[Outcome], left_out: Iterable[str] = ()) -> list[Row]:
    """Scores of all recordings but some, in an order that does not depend on which was finished first."""
    by_name = sorted(outcomes, key=lambda outcome: outcome.recording)
    without = set(left_out)
    return [row for outcome in by_name if outcome.recording not in without for row in outcome.rows]
