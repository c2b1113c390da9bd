"""What tables of several systems share: their recordings, summaries over seeds, their cells, JSON without NaN."""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.metrics.table import Row, Scores, Summary, aggregate
from wearcap.models.checkpoint import read_checkpoint
from wearcap.recording import RecordingStore

TRAINING = {
    "parameters_m": "M param.",
    "frames_seen_m": "M frames",
    "core_minutes": "core min",
    "rate_swept": "rate swept",
    "trainings": "trainings",
}
"""Columns of what a row's training took: trained parameters and frames of drawn windows, both in millions, and minutes of a
core (none, where it was trained on a GPU); the learning rate, where `rivals.py` chose it of several; how many with other seeds the row is the mean of, if several;
and their headings."""
RATE_FILE = "rate.json"
"""In the folder of a run of `rivals.py`: the rate that was chosen, and by what."""
EPOCHS = 12
"""Validations of a training by budget, at most; one of few steps has fewer, which would take longer than it."""
_RECORDED = {
    "parameters_m": ("parameters", 1e6),
    "frames_seen_m": ("frames", 1e6),
    "core_minutes": ("core_seconds", 60.0),
}
"""A checkpoint's own record of each, and how many of its units make one of the column's."""
UPSIDE_DOWN = ("127_32",)
"""Recordings of CMU whose file has the head upside down on an upright neck (158° about one axis), as no head can be: rows
are given with and without them."""
PREPARE = {
    "cmu": "Run: wearcap prepare cmu source=FOLDER",
    "simulated": "Run: wearcap prepare simulated",
    "simulated_hillside": "Run: wearcap prepare simulated world=hillside 'activities=[walk,stand]' "
    "'recordings={val: 3, test: 8}' duration_s=90 output=datasets/simulated_hillside",
    "totalcapture": "Run: wearcap prepare totalcapture source=FOLDER",
    "simulated_objects": "Run: wearcap prepare simulated_objects",
}


def add_people(parser: argparse.ArgumentParser) -> None:
    """Options of tables of people without surroundings."""
    parser.add_argument(
        "--strangers",
        type=Path,
        nargs="+",
        default=[],
        metavar="DATASET",
        help="data sets of people of other laboratories, as datasets/hdm05: a table of each, with the rows of CMU's",
    )
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="of the rows of our checkpoint these alone")
    parser.add_argument(
        "--keep",
        metavar="NAME",
        help="rows of our checkpoint alone, in tables of this name that later runs leave as they are, such as "
        "'before more motion': the page shows them beside those of now",
    )


def titled(title: str, options: argparse.Namespace) -> str:
    """A table's title, behind the name of tables that are kept."""
    return f"{options.keep}, {title}" if options.keep else title


def recordings_of(options: argparse.Namespace, data: str) -> tuple[RecordingStore, list[str]]:
    """A prepared data set, and names of its split as `--split`, `--recordings` and `--quick` say. Raises WearcapError
    where it is missing."""
    return split_of(options, options.datasets / data)


def split_of(options: argparse.Namespace, root: Path) -> tuple[RecordingStore, list[str]]:
    """The same of a data set in a folder."""
    if not (root / "manifest.json").is_file():
        raise WearcapError(
            "no such data set", where=root, fix=PREPARE.get(root.name, f"Run: wearcap prepare {root.name}")
        )
    store = RecordingStore.open(root)
    return store, store.names(options.split)[: 3 if options.quick else options.recordings]


def summarize(values: list[float]) -> dict[str, float | int | None]:
    """Mean and sample deviation over seeds, as JSON; NaN is left out."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return {"mean": math.nan, "std": None, "seeds": 0}
    mean = sum(known) / len(known)
    spread = math.sqrt(sum((v - mean) ** 2 for v in known) / (len(known) - 1)) if len(known) > 1 else None
    return {"mean": mean, "std": spread, "seeds": len(known)}


def cell(summary: dict[str, Any], digits: int = 2) -> str:
    """Mean ± deviation; a dash where there is no finite mean."""
    if summary["mean"] is None or not math.isfinite(summary["mean"]):
        return "–"
    parts = Summary(summary["mean"], summary["std"], summary["seeds"])
    spread = "" if parts.std is None else f" ± {parts.std:.{digits}f}"
    return f"{parts.mean:.{digits}f}{spread}"


class NotRecorded(Summary):
    """A figure that a checkpoint does not carry."""

    def __str__(self) -> str:
        return "not recorded"


def training_of(checkpoint: str, *others: str) -> dict[str, Summary]:
    """What a checkpoint's training took, as columns (`TRAINING`) of its row; `others` are the same with other seeds."""
    config, state = read_checkpoint(checkpoint)
    weights = sum(value.numel() for name, value in state.items() if name.startswith("net."))
    taken: dict[str, Any] = {"parameters": weights, **config.get("training", {})}
    if not str(taken.get("machine", "CPU")).endswith("CPU"):
        taken.pop("core_seconds", None)  # on a GPU they are not what the training took
    found = {
        name: Summary(taken[key] / unit, None, 1) if key in taken else NotRecorded(math.nan, None, 0)
        for name, (key, unit) in _RECORDED.items()
    }
    rate = Path(checkpoint).parent.parent / RATE_FILE
    if Path(checkpoint).is_file() and rate.is_file():
        note = json.loads(rate.read_text(encoding="utf-8"))
        found |= {"rate_swept": Summary(note["rate"], None, 1)} if note["losses"] else {}
    return found | ({"trainings": Summary(1 + len(others), None, 1)} if others else {})


def budget(frames: int, per_step: int) -> list[str]:
    """Overrides of a training that sees so many frames, `per_step` in a batch, or stops when the validation loss has not
    fallen for three epochs; captured with is its checkpoint of the least."""
    steps = max(1, frames // per_step)
    epochs = min(EPOCHS, max(3, steps // 50))
    average = min(0.995, max(0.98, 1 - 20 / steps))
    return [
        *(f"trainer.max_steps={steps}", f"data.loading.steps_per_epoch={max(1, steps // epochs)}"),
        *(f"optimizer.scheduler.warmup={steps // 10}", f"callbacks.average.decay={average:.4g}"),
        *("trainer.precision=bf16-mixed", "early_stop=3"),
    ]


def is_trained(checkpoint: Path) -> bool:
    """Whether a training is there, and not one of `rivals.py` that has not finished."""
    rate = checkpoint.parent.parent / RATE_FILE
    return checkpoint.is_file() and (not rate.is_file() or bool(json.loads(rate.read_text())["finished"]))


def trainings_of(runs: Path, run: str) -> list[Path]:
    """Checkpoints of a training, and of the same with other seeds (`rivals.py --seeds 0 1 2`), those that are there."""
    paths = [runs / seeded / "checkpoints" / "best.ckpt" for seeded in (run, f"{run}_1", f"{run}_2")]
    return [path for path in paths if is_trained(path)]


def left_out(row: str, system: str, run: str, checkpoint: str | Path | None) -> str:
    """A line on a row whose training is not there."""
    command = f"python benchmarks/rivals.py {system} --only {run}"
    return f"left out: {row} (no finished training {checkpoint}); train it by: {command}"


def new_table(title: str, columns: list[str]) -> Table:
    table = Table(title=title)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", no_wrap=True)
    return table


def upright(name: str, scored: Sequence[Row]) -> Scores:
    """A row without the recordings that are `UPSIDE_DOWN`, where there are any."""
    others = [row for row in scored if row.recording not in UPSIDE_DOWN]
    return {f"{name}, without {', '.join(UPSIDE_DOWN)}": aggregate(others)} if len(others) < len(scored) else {}


def plain(scores: Scores) -> dict[str, dict[str, Any]]:
    """Summaries as JSON."""
    return {row: {metric: asdict(value) for metric, value in found.items()} for row, found in scores.items()}


def write_tree(path: Path, tree: dict[str, Any]) -> Path:
    """Write a table's figures as JSON; returns the file."""
    write_text(path, json.dumps(_finite(tree), indent=1, allow_nan=False) + "\n")
    return path


def _finite(tree: Any) -> Any:
    """What is not finite becomes null."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree
