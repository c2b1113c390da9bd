"""What each set of motion brings on validation people of the others: one is left out of training at a time.

The head-alone network (experiment=motion_diffusion_head) is trained on all sets and on all but one, with equal steps, and
captures the validation people of every set. Their bones and exact heads are given. A set without a training split is
only captured. Trainings that are finished are taken from OUTPUT/runs.
"""

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from joblib import Parallel, cpu_count, delayed
from rich.console import Console

from benchmarks.tables.tabling import new_table, plain, split_of, write_tree
from wearcap.cli import train
from wearcap.cli.conf import compose, load_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import evaluate
from wearcap.metrics.table import TRUTH, Row, Summary, aggregate
from wearcap.recording import RecordingStore

EXPERIMENT = "motion_diffusion_head"
ALL, WALKERS = "all sets", "walkers"
SETS = ("cmu", "hdm05", "accad", "ui_prmd", "fubot_vr", "simulated")
KNEE = "stance_knee_deg"
QUICK_STEPS = 300


@dataclass(frozen=True)
class Training:
    """One row's network, of one seed."""

    row: str
    seed: int
    sources: tuple[tuple[str, Path, float], ...]
    """Name, folder and sampling weight of each set that it learns from."""
    validated: Path
    """Folder of a set with a validation split, which trainings report the loss of."""
    steps: int
    run: Path
    overrides: tuple[str, ...]
    """Further ones of `wearcap train`."""

    def checkpoint(self) -> Path:
        """Train it, unless that is finished; returns its last weights, so that all rows have made equally many steps.

        Raises WearcapError where its folder holds a training with other settings.
        """
        given = [f"++data.sources.{name}={{root: '{root}', weight: {weight}}}" for name, root, weight in self.sources]
        absent = [] if any(name == "simulated" for name, _, _ in self.sources) else ["data.sources.simulated=null"]
        config = compose(
            "train",
            [
                *(f"experiment={EXPERIMENT}", "data=simulated", *absent, *given),
                f"data.val_sources={{val: {{root: '{self.validated}', weight: 1.0}}}}",
                *(f"trainer.max_steps={self.steps}", f"data.loading.steps_per_epoch={self.steps}"),
                *(f"optimizer.scheduler.warmup={self.steps // 10}", "callbacks.capture=null"),
                f"callbacks.average.decay={min(0.995, max(0.9, 1 - 20 / self.steps)):.4g}",
                *(f"seed={self.seed}", f"paths.run={self.run}", "resume=auto", *self.overrides),
            ],
        )
        train.train(config)
        return self.run / "checkpoints" / "last.ckpt"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--datasets",
        nargs="+",
        default=[f"{name}=datasets/{name}" for name in SETS],
        metavar="NAME=DIR",
        help="prepared sets with a training split, a validation split, or both",
    )
    parser.add_argument(
        "--weights", nargs="+", default=[], metavar="NAME=WEIGHT", help="shares of the windows; 1 for others"
    )
    parser.add_argument("--steps", type=int, default=1200, help=f"of every training ({QUICK_STEPS} when quick)")
    parser.add_argument("--seeds", type=int, default=3, help="trainings per row (1 when quick)")
    parser.add_argument("--recordings", type=int, help="no more than so many of each validation split (3 when quick)")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    parser.add_argument("--device", default="cpu", help="device that captures")
    parser.add_argument("--overrides", nargs="*", default=[], help="further ones of wearcap train")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Train, capture, print and write the table; returns its path."""
    options.split = "val"
    sets = {name: Path(folder) for name, folder in _pairs(options.datasets)}
    people = {name: split_of(options, root) for name, root in sets.items()}
    learnt = [name for name, (store, _) in people.items() if store.names("train")]
    captured = [name for name, (_, names) in people.items() if names]
    if not captured:
        raise WearcapError(f"no validation people in {', '.join(sets)}", expected="a set with some")
    if len(learnt) < 2:
        raise WearcapError(f"training splits of {', '.join(learnt) or 'no set'}", expected="those of two sets or more")
    trainings = _trainings(options, sets, learnt, sets[captured[0]])
    threads = max(1, cpu_count() // options.jobs)
    jobs = (delayed(_scored)(each, people, options.device, threads) for each in trainings)
    rows: dict[str, dict[str, list[Row]]] = {}
    for one, scored in zip(trainings, cast(Iterable, Parallel(n_jobs=options.jobs, return_as="generator")(jobs))):
        for name, found in scored.items():
            rows.setdefault(one.row, {}).setdefault(name, []).extend(found)
    scores = {row: {name: aggregate(found) for name, found in by_set.items()} for row, by_set in rows.items()}
    _show(scores, captured)
    minutes = {
        name: {split: _minutes(store, split) for split in ("train", "val")} for name, (store, _) in people.items()
    }
    content = {"steps": trainings[0].steps, "weights": dict(_pairs(options.weights)), "minutes": minutes}
    found = {row: plain(by_set) for row, by_set in scores.items()}
    path = options.output / "sets.json"
    return write_tree(path, {"about": about | {"quick": str(options.quick)}, **content, "rows": found})


def _pairs(given: list[str]) -> list[tuple[str, str]]:
    """NAME=VALUE as pairs. Raises WearcapError for others."""
    pairs = [(name, value) for name, _, value in (each.partition("=") for each in given)]
    if wrong := [each for each, (name, value) in zip(given, pairs) if not name.isidentifier() or not value]:
        raise WearcapError(f"no pair: {', '.join(wrong)}", expected="NAME=VALUE")
    return pairs


def _trainings(
    options: argparse.Namespace, sets: dict[str, Path], learnt: list[str], validated: Path
) -> list[Training]:
    """All rows' trainings: those on all sets first."""
    weights = {name: float(weight) for name, weight in _pairs(options.weights)}
    steps = QUICK_STEPS if options.quick else options.steps
    found = []
    for left_out in (None, *learnt):
        row = ALL if left_out is None else f"without {left_out}"
        sources = tuple((name, sets[name].resolve(), weights.get(name, 1.0)) for name in learnt if name != left_out)
        for seed in range(1 if options.quick else options.seeds):
            run = options.output / "runs" / f"sets_{row.replace(' ', '_')}_{steps}_{seed}"
            found.append(Training(row, seed, sources, validated.resolve(), steps, run, tuple(options.overrides)))
    return found


def _scored(
    one: Training, people: dict[str, tuple[RecordingStore, list[str]]], device: str, threads: int
) -> dict[str, list[Row]]:
    """Rows of one training by set, and of all recordings in which somebody walks."""
    torch.set_num_threads(threads)
    pipeline = load_pipeline(
        one.checkpoint(), compose("evaluate", ["pipeline=hmd2", "checkpoint=none"]).pipeline, device
    )
    found = {
        name: [
            replace(row, recording=f"{name}/{row.recording}", seed=one.seed)
            for row in evaluate(pipeline, store, names, (0,))
        ]
        for name, (store, names) in people.items()
        if names
    }
    walks = [row for rows in found.values() for row in rows if KNEE in row.scores]
    return found | ({WALKERS: walks} if walks else {})


def _minutes(store: RecordingStore, split: Any) -> float:
    return sum(store.entries[name].duration_s for name in store.names(split)) / 60


def _show(scores: dict[str, dict[str, dict[str, Summary]]], captured: list[str]) -> None:
    """Errors by set, and the knee in stance of all who walk beside that of the truth."""
    table = new_table("MPJPE (cm) of validation people", ["trained on", *captured, "stance knee, deg", "of the truth"])
    for row, by_set in scores.items():
        walks = by_set.get(WALKERS, {})
        knees = [str(walks[name]) if name in walks else "–" for name in (KNEE, f"{TRUTH}{KNEE}")]
        table.add_row(row, *(str(by_set[name]["mpjpe_cm"]) for name in captured), *knees)
    Console(width=max(100, 30 + 16 * len(captured))).print(table)
