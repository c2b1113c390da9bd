"""Trains the learned rivals of a system, and ours at their budget, each at the best of a few learning rates.

    python benchmarks/rivals.py SYSTEM [--budget FRAMES] [--batch WINDOWS] [--rates 3e-4 1e-3 3e-3] [--seeds 0]
        [--only NAME …] [--jobs N]

SYSTEM is hmd2, mocap_every or echo; names and settings of the trainings are those of its tables (`RUNS`, `training`),
which take RUNS/NAME/checkpoints/best.ckpt. Of each rate a tenth of the budget is trained; the rate of the least validation
loss then trains on all of it, or until the validation loss has not fallen for three epochs. RUNS/NAME/rate.json says how
the rate was chosen, and the tables print it. The same command goes on after a kill, and leaves alone what is finished.
"""

import argparse
import csv
import importlib
import json
import math
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from joblib import Parallel, cpu_count, delayed

from benchmarks.rivals import compose
from benchmarks.tables.tabling import RATE_FILE
from wearcap.cli import train
from wearcap.errors import WearcapError
from wearcap.files import write_text

SYSTEMS = ("hmd2", "mocap_every", "echo")
SWEPT = 0.1
"""Share of the budget that each rate of the sweep is trained for."""


@dataclass(frozen=True)
class Rival:
    """One training of a system's tables."""

    system: str
    name: str
    frames: int
    """Frames that it sees at most."""
    rates: tuple[float, ...]
    seeds: tuple[int, ...]
    runs: Path
    overrides: tuple[str, ...] = ()
    """Further ones of `wearcap train`."""
    batch: int | None = None
    """Windows of a batch; none: the tables' own number."""

    @property
    def folder(self) -> Path:
        return self.runs / self.name

    def fit(self, rate: float, share: float, run: Path, seed: int = 0) -> float:
        """Train on a share of the budget, from where an earlier attempt was stopped; returns the least validation loss."""
        table = importlib.import_module(f"benchmarks.tables.{self.system}")
        given = [*table.training(self.name, round(share * self.frames), self.batch), *self.overrides, f"seed={seed}"]
        place = [f"name={self.name}", f"paths.run={run}", "resume=auto", "++callbacks.capture=null"]
        train.train(compose("train", [*given, f"optimizer.optimizer.lr={rate:g}", *place]))
        return least_loss(run / "metrics.csv")


def least_loss(metrics: Path) -> float:
    """The least validation loss of a run; infinite without any."""
    with open(metrics, newline="") as file:
        values = [float(row["val/loss"]) for row in csv.DictReader(file) if row.get("val/loss")]
    return min((value for value in values if math.isfinite(value)), default=math.inf)


def train_rival(rival: Rival, threads: int) -> str:
    """Sweep, choose, train; returns a line on what was done. Raises WearcapError where another budget was trained, and
    where no rate gives a finite loss."""
    torch.set_num_threads(threads)
    note = _note(rival)
    for rate in rival.rates:
        if len(rival.rates) > 1 and "rate" not in note and f"{rate:g}" not in note["losses"]:
            loss = rival.fit(rate, SWEPT, rival.folder / "sweep" / f"{rate:g}")
            _keep(rival, note, losses=note["losses"] | {f"{rate:g}": loss if math.isfinite(loss) else None})
    if "rate" not in note:
        _keep(rival, note, rate=_best(rival, note["losses"]))
        shutil.rmtree(rival.folder / "sweep", ignore_errors=True)
    for seed in rival.seeds:
        if str(seed) not in note["finished"]:
            run = rival.folder if seed == 0 else rival.folder.with_name(f"{rival.name}_{seed}")
            loss = rival.fit(note["rate"], 1.0, run, seed)
            _keep(rival, note, finished=note["finished"] | {str(seed): loss})
            if seed:
                write_text(run / RATE_FILE, json.dumps(note, indent=1) + "\n")
    swept = ", ".join(
        f"{rate}: {'no finite loss' if loss is None else f'{loss:.4g}'}" for rate, loss in note["losses"].items()
    )
    return f"{rival.name}: rate {note['rate']:g} ({swept or 'not swept'}); validation loss {note['finished']}"


def _note(rival: Rival) -> dict[str, Any]:
    """What is known of earlier attempts with the same budget and settings."""
    path = rival.folder / RATE_FILE
    settings = {"frames": rival.frames, "batch": rival.batch, "overrides": list(rival.overrides)}
    if not path.is_file():
        return {**settings, "losses": {}, "finished": {}}
    note = json.loads(path.read_text(encoding="utf-8"))
    before = {key: note.get(key) for key in settings}
    if before != settings:
        what, asked = (", ".join(f"{key} {value}" for key, value in each.items()) for each in (before, settings))
        raise WearcapError(f"{rival.name} has been trained with {what}", rival.folder, asked, "Move it away.")
    return note


def _keep(rival: Rival, note: dict[str, Any], **found: Any) -> None:
    note |= found
    rival.folder.mkdir(parents=True, exist_ok=True)
    write_text(rival.folder / RATE_FILE, json.dumps(note, indent=1, allow_nan=False) + "\n")


def _best(rival: Rival, losses: dict[str, float | None]) -> float:
    """The rate of the least loss; the only one where there was no sweep."""
    if not losses:
        return rival.rates[0]
    finite = {rate: loss for rate, loss in losses.items() if loss is not None}
    if not finite:
        raise WearcapError(
            f"{rival.name}: no rate of {', '.join(losses)} gives a finite loss", fix="Give lower --rates."
        )
    return float(min(finite, key=lambda rate: finite[rate]))


def _attempt(rival: Rival, threads: int) -> tuple[bool, str]:
    try:
        return True, train_rival(rival, threads)
    except WearcapError as error:
        return False, f"error: {error}"


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser("rivals.py", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("system", choices=SYSTEMS)
    parser.add_argument(
        "--budget", type=int, metavar="FRAMES", help="frames that each sees; default: the tables' BUDGET"
    )
    parser.add_argument("--batch", type=int, metavar="WINDOWS", help="windows of a batch; default: the tables' own")
    parser.add_argument("--rates", type=float, nargs="+", default=[3e-4, 1e-3, 3e-3], help="one: no sweep")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], help="trainings at the best rate; the sweep has one"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these trainings alone")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    parser.add_argument("--runs", type=Path, default=Path("outputs/train"), help="folder of the trainings, by name")
    parser.add_argument(
        "--overrides", nargs="*", default=[], help="further ones of wearcap train, as paths.datasets=DIR"
    )
    options = parser.parse_args(arguments)
    table = importlib.import_module(f"benchmarks.tables.{options.system}")
    names = options.only or list(table.RUNS)
    if unknown := sorted(set(names) - set(table.RUNS)):
        parser.error(f"no training {', '.join(unknown)}. Expected some of {', '.join(table.RUNS)}")
    rest = (
        options.budget or table.BUDGET,
        tuple(options.rates),
        tuple(options.seeds),
        options.runs,
        tuple(options.overrides),
        options.batch,
    )
    threads = max(1, cpu_count() // options.jobs)
    rivals = [Rival(options.system, name, *rest) for name in names]
    jobs = (delayed(_attempt)(rival, threads) for rival in rivals)
    outcomes = cast(Iterable[tuple[bool, str]], Parallel(n_jobs=options.jobs, return_as="generator")(jobs))
    failed = 0
    for done, line in outcomes:
        print(line, flush=True)
        failed += not done
    sys.exit(1 if failed else 0)
