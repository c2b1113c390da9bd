"""One row of HMD²'s tables: a method captures recordings of a data set with every seed, and is scored."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from benchmarks.rivals import compose
from benchmarks.tables.result_pages import Tree, summaries
from benchmarks.tables.sensed import SensedStore
from benchmarks.tables.tabling import training_of
from wearcap.cli.conf import load_pipeline
from wearcap.evaluation.baselines import BASELINES
from wearcap.evaluation.breakdown import by_activity
from wearcap.evaluation.evaluate import Realism, evaluate
from wearcap.metrics.scores import score
from wearcap.metrics.table import Row, Summary, aggregate
from wearcap.recording import Motion, RecordingStore
from wearcap.runtime.system import CaptureInput

STRIDE_S = 0.5
"""Windows of FID and Diversity are this far apart."""
BEST = ("mpjpe_cm", "hand_pe_cm", "upper_pe_cm", "lower_pe_cm")
"""Errors of the best sample of each recording that are reported."""


@dataclass(frozen=True)
class Method:
    """A row: what captures, and how. Without checkpoint, one of `BASELINES`."""

    name: str
    checkpoint: str | None = None
    pipeline: tuple[str, ...] = ("pipeline=hmd2",)
    """Overrides of conf/evaluate.yaml."""
    sensors: str | None = None
    """Preset of the device's errors (`WEARABLES`), or `GIVEN`; None: the case's."""
    height_off_m: float | None = None
    """How far the height that the wearer gives is off (m); None: as the preset knows it."""
    others: tuple[str, ...] = ()
    """Checkpoints of the same training with other seeds, which the row is the mean of, too, each captured once."""


@dataclass(frozen=True)
class Case:
    """What a row is measured on; picklable."""

    dataset: Path
    names: tuple[str, ...]
    seeds: tuple[int, ...]
    training: tuple[str, ...]
    """Data sets whose training splits the baselines learn from."""
    realism: str | None
    sensors: str
    """Preset of the device's errors, unless a row has its own."""
    device: str = "cpu"
    stride_s: float = STRIDE_S


@dataclass(frozen=True)
class Result:
    """Scores of a row over seeds, with what its training took: of all recordings, and by what was mostly done in them."""

    method: str
    scores: dict[str, Summary]
    activities: dict[str, dict[str, Summary]]

    @classmethod
    def of(cls, tree: Tree) -> "Result":
        """As it was before it became JSON."""
        activities = {name: summaries(scores) for name, scores in tree["activities"].items()}
        return cls(tree["method"], summaries(tree["scores"]), activities)


def run_method(method: Method, case: Case) -> Result:
    """Capture and score. Raises what the verbs of wearcap raise."""
    torch.set_num_threads(1)
    store = SensedStore.open(case.dataset, method.sensors or case.sensors, method.height_off_m)
    if method.checkpoint is None:
        runs = [(BASELINES[method.name].fit([RecordingStore.open(root) for root in case.training]), case.seeds[:1])]
    else:
        config = compose("evaluate", [*method.pipeline, "checkpoint=none"]).pipeline
        seeds = case.seeds[:1] if "pipeline=pose_regressor" in method.pipeline else case.seeds
        runs = [(load_pipeline(method.checkpoint, config, case.device), seeds)]
        if method.others:
            paths = (method.checkpoint, *method.others)
            runs = [(load_pipeline(path, config, case.device), (number,)) for number, path in enumerate(paths)]
    realism = None if case.realism is None else Realism.load(case.realism, case.stride_s)
    of_truth = scored if realism is None else realism.beside(scored, method.name)

    def measure(motion: Motion, source: CaptureInput, seed: int) -> Row:
        return of_truth(motion, CaptureInput(store.true(source.recording.name)), seed)

    rows = [
        row
        for pipeline, seeds in runs
        for row in evaluate(pipeline, store, case.names, seeds, batch_size=8, measure=measure)
    ]
    scores = aggregate(rows)
    if len(runs) == 1 and len(runs[0][1]) > 1:
        scores |= {f"best_{name}": value for name, value in aggregate(best_of(rows)).items() if name in BEST}
    if realism is not None:
        scores |= realism.scores(method.name)
    if method.checkpoint is not None:
        scores |= training_of(method.checkpoint, *method.others)
    return Result(
        method.name, scores, by_activity(rows, {name: store.entries[name].context.activity for name in case.names})
    )


def best_of(rows: list[Row]) -> list[Row]:
    """Of each recording the sample with the least MPJPE, as if of one seed."""
    best: dict[str, Row] = {}
    for row in rows:
        known = best.get(row.recording)
        if known is None or row.scores["mpjpe_cm"] < known.scores["mpjpe_cm"]:
            best[row.recording] = row
    return [replace(row, seed=0) for row in best.values()]


def scored(motion: Motion, source: CaptureInput, seed: int) -> Row:
    """`score`, and how much more it jerks where windows meet than elsewhere."""
    row = score(motion, source.recording, source.recording.name, seed)
    if (ratio := seam_ratio(motion)) is not None:
        row.scores["seam_ratio"] = ratio
    return row


def seam_ratio(motion: Motion) -> float | None:
    """Third difference of joint positions where frames of two windows meet, as a share of that between; None without either.

    The first four seconds, in which windows grow, are left out.
    """
    if "stride" not in motion.provenance:
        return None
    stride, lookahead_frames = (int(motion.provenance[key]) for key in ("stride", "lookahead"))
    jerk = motion.T_world_joint.t.diff(dim=0, n=3).norm(dim=-1).mean(-1)
    phase = (torch.arange(len(jerk)) + lookahead_frames) % stride
    grown = torch.arange(len(jerk)) >= 240
    seam = phase >= stride - 3
    if stride < 6 or not (grown & seam).any():
        return None
    return (jerk[grown & seam].mean() / jerk[grown & ~seam].mean()).item()
