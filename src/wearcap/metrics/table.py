"""Scores of a motion, their mean over recordings and spread over seeds, and tables of them."""

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from rich.console import Group
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rigid import Rigid
from wearcap.metrics import gait, physics, position
from wearcap.metrics.certainty import certainty_scores
from wearcap.metrics.posture import PREFIX, errors_by_posture, postures
from wearcap.recording.motion import Motion

MAX_DECIMALS = 6
WIDTH = 80
"""Characters of a terminal that tables fit."""
LEAST_OF_TRUTH = 0.05
"""A value of the truth (in the metric's unit) below which a ratio to it says nothing."""
P95 = "p95_"
"""Beginning of the names of 95th percentiles, which the thesis averages over sequences (Table 6.6)."""

TRUTH = "truth_"
"""Beginning of the names of scores that belong to the true motion."""

PER_RECORDING = (P95, "stance_knee_", "knee_curve_")
"""Beginnings of the names of scores, also behind `TRUTH`, that are averaged over the recordings that have them; all others
are averaged over frames."""

RATIOS = {"skate_ratio": "foot_skate_cm_s", "jitter_ratio": "jitter_m_s3"}
"""Scores that are shares of the truth's, and what of."""


@dataclass(frozen=True)
class Row:
    """Scores of one recording captured with one seed."""

    recording: str
    seed: int
    frames: int
    scores: dict[str, float]


@dataclass(frozen=True)
class Summary:
    """Mean and sample standard deviation over seeds (None for a single seed)."""

    mean: float
    std: float | None
    seeds: int

    def __str__(self) -> str:
        digits = decimals(self.mean)
        return f"{self.mean:.{digits}f}" if self.std is None else f"{self.mean:.{digits}f} ± {self.std:.{digits}f}"


def decimals(value: float, least: int = 2) -> int:
    """Decimals that show two digits of a small value: 2 for 1.234, 4 for 0.0012, `least` for 0 and NaN."""
    if not math.isfinite(value) or value == 0:
        return least
    return max(least, min(1 - math.floor(math.log10(abs(value))), MAX_DECIMALS))


def evaluate_motion(
    prediction: Motion, truth: Motion, contact: Bool[Tensor, "time patch"] | None = None
) -> dict[str, float]:
    """All metrics of one captured motion against ground truth, by name with unit; those of the truth alone begin with
    `TRUTH`.

    contact: true contact of `FOOT_PATCHES` at the truth's frames; None: estimated from the true motion
    (`contact_from_motion`). Raises WearcapError unless both motions have the same joints and timestamps and finite
    values.
    """
    _require_comparable(prediction, truth)
    if contact is not None and len(contact) != len(truth):
        what = f"{len(contact)} frames of contact for {len(truth)} frames of motion"
        raise WearcapError(what, expected="true contact at the truth's frames")
    fps = truth.fps
    pose, pose_true = _double_pose(prediction), _double_pose(truth)
    joints, joints_true = pose.t, pose_true.t
    floor = physics.local_floor(joints_true, fps)
    if contact is None:
        points_true = physics.foot_points(truth.skeleton, pose_true)
        touching = physics.contact_from_motion(points_true, floor, fps)
    else:
        touching = physics.foot_contact(contact)
    plausible = physics.plausibility(prediction.skeleton, pose, touching, floor, fps)
    plausible_true = physics.plausibility(truth.skeleton, pose_true, touching, floor, fps)
    error = position.joint_error_cm(joints, joints_true)
    parts = {
        f"{part}_pe_cm": error[:, indices].mean(-1) for part, indices in position.body_parts(truth.skeleton).items()
    }
    tails = {"cm": error.mean(-1), **parts, "floor_penetration_cm": physics.floor_depth_cm(joints, floor)}
    scores = {
        "mpjpe_cm": error.mean(),
        **{name: value.mean() for name, value in parts.items()},
        **{f"{part}_pe_cm": value for part, value in position.part_errors_cm(truth.skeleton, error).items()},
        **{f"{P95}{name}": position.error_percentile_cm(value) for name, value in tails.items()},
        "root_cm": position.root_error_cm(joints[:, 0], joints_true[:, 0]),
        "mpjve_cm_s": position.mpjve_cm_s(joints, joints_true, fps),
        "rotation_deg": position.rotation_error_deg(prediction.R_parent_joint, truth.R_parent_joint),
        "jitter_ratio": plausible["jitter_m_s3"] / plausible_true["jitter_m_s3"],
        **plausible,
        **{f"{TRUTH}{name}": value for name, value in plausible_true.items()},
    }
    found = {name: float(value) for name, value in scores.items()}
    of_truth = postures(truth.skeleton, pose_true, floor, fps)
    found |= errors_by_posture(truth.skeleton, of_truth, error, "cm")
    return found | both_walking(prediction, truth) | certainty_scores(prediction, truth)


def both_walking(prediction: Motion, truth: Motion) -> dict[str, float]:
    """How the knees of a captured motion and of the truth move over the truth's walking cycles (`gait.walking_scores`);
    nothing where it has none. Both have the same timestamps."""
    cycles = gait.cycle_times(truth)
    own = gait.walking_scores(truth, cycles)
    return gait.walking_scores(prediction, cycles) | {f"{TRUTH}{name}": value for name, value in own.items()}


def _double_pose(motion: Motion) -> Rigid:
    """Joint poses in float64: in float32, metres from the origin, rounding alone causes a jitter of 1 m/s³."""
    return forward_kinematics(motion.skeleton, motion.R_parent_joint.double(), motion.t_world_root.double())


def _require_comparable(prediction: Motion, truth: Motion) -> None:
    if prediction.skeleton.joint_names != truth.skeleton.joint_names:
        what = f"captured on skeleton {prediction.skeleton.name!r}, true on {truth.skeleton.name!r}"
        raise WearcapError(what, expected="the same joints", fix="Retarget one of them first.")
    if len(truth) < 2:
        raise WearcapError(f"a motion of {len(truth)} frames cannot be scored", expected="at least two frames")
    same_clock = len(prediction) == len(truth) and torch.allclose(
        prediction.timestamps, truth.timestamps, rtol=0.0, atol=1e-6
    )
    if not same_clock:
        raise WearcapError(
            f"captured motion has {len(prediction)} frames from {_span(prediction)}, the truth {len(truth)} from "
            f"{_span(truth)}",
            expected="the same timestamps",
            fix="Resample the captured motion first.",
        )
    for name, motion in (("captured", prediction), ("true", truth)):
        finite = motion.R_parent_joint.isfinite().all((1, 2, 3)) & motion.t_world_root.isfinite().all(1)
        if not finite.all():
            first = int((~finite).nonzero()[0])
            raise WearcapError(f"the {name} motion is not finite at frame {first}", expected="finite poses")


def _span(motion: Motion) -> str:
    if not len(motion):
        return "no time"
    return f"{motion.timestamps[0].item():.3f} to {motion.timestamps[-1].item():.3f} s"


def aggregate(rows: list[Row]) -> dict[str, Summary]:
    """Mean over recordings within each seed, weighted by frames (`PER_RECORDING`: equally), then mean
    and spread over seeds. Scores that are NaN or missing (no contact, no walking, too few frames) are ignored, as are those by
    posture (`breakdown.by_posture`). Where there are both, `RATIOS` of these means to the truth's are added.

    Raises WearcapError unless every seed was scored on the same recordings, once each.
    """
    by_seed: dict[int, dict[str, Row]] = defaultdict(dict)
    for row in rows:
        if row.recording in by_seed[row.seed]:
            raise WearcapError(f"recording {row.recording!r} is scored twice for seed {row.seed}")
        by_seed[row.seed][row.recording] = row
    seen = {frozenset(recordings) for recordings in by_seed.values()}
    if len(seen) != 1:
        raise WearcapError("the seeds were not scored on the same recordings" if seen else "nothing was scored")
    by_metric: dict[str, list[float]] = {}
    for name in dict.fromkeys(name for row in rows for name in row.scores if not name.startswith(PREFIX)):
        means = []
        for recordings in by_seed.values():
            scored = [(row.scores.get(name, math.nan), row.frames) for row in recordings.values()]
            known = [(score, frames) for score, frames in scored if not math.isnan(score)]
            equally = name.removeprefix(TRUTH).startswith(PER_RECORDING)
            weighted = [(score, 1 if equally else frames) for score, frames in known]
            total = sum(weight for _, weight in weighted)
            means.append(sum(score * weight for score, weight in weighted) / total if total else math.nan)
        by_metric[name] = means
    for name, metric in RATIOS.items():
        if name not in by_metric and {metric, f"{TRUTH}{metric}"} <= set(by_metric):
            both = zip(by_metric[metric], by_metric[f"{TRUTH}{metric}"])
            by_metric[name] = [value / true if true >= LEAST_OF_TRUTH else math.nan for value, true in both]
    return {name: summarize(means) for name, means in by_metric.items()}


def summarize(values: list[float]) -> Summary:
    """Mean and sample standard deviation of one score over seeds."""
    mean = sum(values) / len(values)
    if len(values) == 1:
        return Summary(mean, None, 1)
    spread = math.sqrt(sum((value - mean) ** 2 for value in values) / (len(values) - 1))
    return Summary(mean, spread, len(values))


Scores = dict[str, dict[str, Summary]]
"""Summaries by method ("ours", "mean pose" …) and metric."""


def truth_row(scores: dict[str, Summary]) -> dict[str, Summary]:
    """The truth's own values as a row beside that of a method, whose scores hold them under names with `TRUTH`."""
    return {name.removeprefix(TRUTH): value for name, value in scores.items() if name.startswith(TRUTH)}


Columns = Sequence[str] | Mapping[str, str]
"""Metrics of a table, or the headings of their columns by metric."""


def _cells(methods: Scores, metrics: Columns | None) -> list[list[str]]:
    """One line per method: its name, then its metrics (default: all metrics of the first method)."""
    columns = list(metrics or next(iter(methods.values())))
    headings = list(metrics.values()) if isinstance(metrics, Mapping) else columns
    lines = [
        [
            method,
            *(str(each) if (each := scores.get(metric)) and not math.isnan(each.mean) else "–" for metric in columns),
        ]
        for method, scores in methods.items()
    ]
    return [["method", *headings], *lines]


def markdown_table(methods: Scores, metrics: Columns | None = None) -> str:
    """A table in Markdown: one line per method, one column per metric."""
    header, *lines = _cells(methods, metrics)
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rule, *lines))


def rich_table(title: str, methods: Scores, metrics: Columns | None = None) -> Table | Group:
    """A table for a terminal: one line per metric, one column per method; several if they are too many for `WIDTH`."""
    header, *lines = _cells(methods, metrics)
    return _fitting(title, ["", *header[1:]], lines)


def rich_lines(title: str, methods: Scores, metrics: Columns | None = None) -> Table | Group:
    """One line per method, one column per metric; several tables if these are too many for `WIDTH`."""
    header, *lines = _cells(methods, metrics)
    by_metric = zip(header[1:], *(line[1:] for line in lines))
    return _fitting(title, ["", *(line[0] for line in lines)], [list(each) for each in by_metric])


def _fitting(title: str, names: list[str], columns: list[list[str]]) -> Table | Group:
    """Columns, each a heading and its cells, beside the names of the lines, in tables that fit `WIDTH`."""
    groups: list[list[list[str]]] = []
    free = 0
    for column in columns:
        heading, *cells = column
        width = max(map(len, [*heading.split(), *cells])) + 3
        if not groups or width > free:
            groups.append([])
            free = WIDTH - max(map(len, names)) - 4
        groups[-1].append(column)
        free -= width
    tables = []
    for group in groups:
        table = Table(title=None if tables else title)
        table.add_column("", no_wrap=True)
        for heading, *_ in group:
            table.add_column(heading, justify="right")
        for row in list(zip(names, *group))[1:]:
            table.add_row(*map(escape, row))
        tables.append(table)
    return tables[0] if len(tables) == 1 else Group(*tables)


def write_scores(
    path: str | Path,
    methods: Scores,
    about: dict[str, str | int | float] | None = None,
    activities: Mapping[str, Scores] | None = None,
    recordings: Mapping[str, str] | None = None,
    postures: Mapping[str, Scores] | None = None,
) -> None:
    """Write a table as JSON, atomically: {"about", "methods": {method: {metric: {mean, std, seeds}}}}; values that
    are not finite become null. `activities`, `postures`: the same by method and activity or posture; `recordings`: names by place ("worst" …)."""
    tree: dict[str, Any] = {"about": about or {}, "methods": _plain(methods)}
    for name, parts in (("activities", activities), ("postures", postures)):
        if parts:
            tree[name] = {method: _plain(scores) for method, scores in parts.items()}
    if recordings:
        tree["recordings"] = dict(recordings)
    write_text(path, json.dumps(tree, indent=1, allow_nan=False) + "\n")


def _plain(methods: Scores) -> dict[str, Any]:
    """Summaries as JSON."""
    return {
        method: {
            metric: {
                key: value if value is not None and math.isfinite(value) else None
                for key, value in asdict(summary).items()
            }
            for metric, summary in scores.items()
        }
        for method, scores in methods.items()
    }
