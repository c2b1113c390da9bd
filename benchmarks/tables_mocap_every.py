"""MocapEvery on held-out people and places: the paper's Tables 2 to 7 on the data at hand.

Bodies are measured where they are put in the world. Checkpoints come by name (checkpoints/) or path; those of baselines
and ablations from RUNS/NAME/checkpoints/best.ckpt, and further seeds of a training from RUNS/NAME_1 and RUNS/NAME_2: the
table gives their mean and spread. A row without its checkpoint is left out, and the command that trains it is printed
(`TRAININGS`).
"""

import argparse
import json
import shlex
from pathlib import Path

from mocap_every_calibration import GOALS, calibration_scores
from mocap_every_rows import Method, body_row, captures, cue_row, floor_row, pipeline_of
from rich.console import Console
from rich.progress import Progress
from tabling import TRAINING, finite, recordings_of, training_of

from wearcap.files import write_text
from wearcap.metrics.table import Scores, Summary, aggregate, markdown_table
from wearcap.models.checkpoint import checkpoint_file
from wearcap.systems.mocap_every.energy import LatentSolver
from wearcap.systems.mocap_every.visual_cues import load_visual_cues

BODY = (
    "r_mpjpe_cm",
    "mpjpe_cm",
    "mpjve_cm_s",
    "root_cm",
    "jitter_ratio",
    "upper_pe_cm",
    "lower_pe_cm",
    "hand_pe_cm",
    "foot_skate_cm_s",
    *TRAINING,
)
FLOOR = ("upper_pe_cm", "lower_pe_cm", "mpjpe_cm", "floor_cm", "floor_within_3cm", "floor_within_3cm_smoothed")
CUES = ("right_hand_cm", "right_arm_cm", "upper_cm", "mpjpe_cm", "jitter_m_s3")
OURS = "experiment=mocap_every"
TRAININGS: dict[str, tuple[str, ...]] = {
    "mocap_every_avatarposer": ("experiment=baseline/mocap_every_avatarposer",),
    "mocap_every_agrol": ("experiment=baseline/mocap_every_agrol",),
    "mocap_every_agrol_hands": ("experiment=baseline/mocap_every_agrol", "model.features.wrists=positions"),
    "mocap_every_paper": ("experiment=paper/mocap_every",),
    "mocap_every_neither": (
        OURS,
        "model.net.multi_stage=false",
        "model.features.frame=world",
        "model.features.absolute=false",
    ),
    "mocap_every_one_stage": (OURS, "model.net.multi_stage=false"),
    "mocap_every_short": (OURS,),
    "mocap_every_hands": (OURS, "model.features.wrists=positions"),
}
"""Overrides of `wearcap train` by the run's name: ablations after the paper's Table 7 without its first stage, and
without its data representation as well (world coordinates); and AvatarPoser's protocol 1, with tracked hands instead of
accelerations."""
STEPS = ("trainer.max_steps=3250", "data.loading.steps_per_epoch=250")
"""All of these are trained as long as `mocap_every` was; captured with is each one's checkpoint of the lowest validation
loss, as there."""
TRAINED = {
    "AvatarPoser-style, watches": (
        "mocap_every_avatarposer",
        ("pipeline=mocap_every", "pipeline.stride=1", "pipeline.lookahead=0", "pipeline.mirror_average=false"),
    ),
    "AGRoL's MLP, watches (AGRoL*)": ("mocap_every_agrol", ("pipeline=mocap_every", "pipeline.mirror_average=false")),
    "AGRoL's MLP, hands tracked": (
        "mocap_every_agrol_hands",
        ("pipeline=mocap_every", "pipeline.mirror_average=false"),
    ),
    "as in the paper": ("mocap_every_paper", ("pipeline=paper/mocap_every",)),
    "neither": ("mocap_every_neither", ("pipeline=mocap_every",)),
    "+ representation": ("mocap_every_one_stage", ("pipeline=mocap_every",)),
    "+ multi-stage": ("mocap_every_short", ("pipeline=mocap_every",)),
    "+ multi-stage, hands tracked": ("mocap_every_hands", ("pipeline=mocap_every",)),
}
"""Rows: run, and pipeline."""
PAPER: Scores = {
    name: {key: Summary(value, None, 1) for key, value in zip(BODY, values)}
    for name, values in {
        "paper: AMASS": (4.95, 5.20, 17.00, 4.36, 1.64),
        "paper: neither": (5.85, 8.50, 27.63),
        "paper: + representation": (5.58, 6.71, 23.69),
    }.items()
}
FLOORS = ("fixed", "update", "points", "follow")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--datasets", type=Path, default=Path("datasets"), help="folder of the prepared data sets")
    parser.add_argument("--split", default="test", help="train, val or test")
    parser.add_argument("--checkpoint", default="mocap_every", help="our checkpoint")
    parser.add_argument("--manifold", default="motion_manifold", help="where motion is edited by cues")
    parser.add_argument("--runs", type=Path, default=Path("outputs/train"), help="folder of the other trainings")
    parser.add_argument("--recordings", type=int, help="no more than so many of each data set")
    parser.add_argument("--sessions", type=int, default=30, help="simulated calibrations")
    parser.add_argument("--parts", nargs="*", default=["body", "floor", "cues", "calibration"], help="tables to make")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the tables; returns the file."""
    console, found = Console(width=170), {}
    with Progress(transient=True, console=console) as progress:
        for part in options.parts:
            title, columns, scores = PARTS[part](options, progress)
            found[title] = {method: {k: vars(v) for k, v in row.items()} for method, row in scores.items()}
            console.print(f"\n{title}\n\n{markdown_table(scores, columns)}", markup=False, soft_wrap=True)
    path = options.output / "mocap_every.json"
    write_text(path, json.dumps(finite({"about": about, "tables": found}), indent=1) + "\n")
    return path


def _body(options: argparse.Namespace, progress: Progress) -> tuple[str, tuple[str, ...], Scores]:
    """Tables 2, 5, 6 and 7: held-out CMU subjects with synthetic watches on a floor that is known to be level."""
    level = "pipeline.floor=fixed"
    ours = [
        Method("ours", options.checkpoint, ("pipeline=mocap_every", level)),
        Method("ours, floor followed", options.checkpoint),
        Method(
            "ours, without mirror averaging",
            options.checkpoint,
            ("pipeline=mocap_every", level, "pipeline.mirror_average=false"),
        ),
        Method(
            "ours, not anchored to the head",
            options.checkpoint,
            ("pipeline=mocap_every", level, "pipeline.anchor=false"),
        ),
        Method("ours, three frames at a time", options.checkpoint, ("pipeline=mocap_every_online", level)),
        Method("ours, heads as by SLAM", options.checkpoint, slam=True),
        Method(
            "ours, heads as by SLAM, not anchored",
            options.checkpoint,
            ("pipeline=mocap_every", "pipeline.anchor=false"),
            slam=True,
        ),
    ]
    trained = {}
    for name, (run, pipeline) in TRAINED.items():
        paths = [options.runs / seeded / "checkpoints" / "best.ckpt" for seeded in (run, f"{run}_1", f"{run}_2")]
        trained[name] = [Method(name, str(path), (*pipeline, level)) for path in paths if path.is_file()]
        if not trained[name]:
            command = shlex.join(
                ["wearcap", "train", *TRAININGS[run], *STEPS, f"name={run}", f"paths.run={options.runs / run}"]
            )
            progress.console.print(
                f"left out: {name} (no {paths[0]}); train it by: {command}", markup=False, soft_wrap=True
            )
    rows = {name: methods for name, methods in trained.items() if methods}
    rows |= {method.name: [method] for method in ours}
    store, names = recordings_of(options, "cmu")
    scores = {}
    for name, methods in rows.items():
        bar = progress.add_task(name, total=len(methods) * len(names))
        scored = [
            body_row(recording, captured, seed)
            for seed, method in enumerate(methods)
            for recording, captured in captures(method, store, names, lambda b=bar: progress.advance(b))
        ]
        scores[name] = aggregate(scored) | training_of(methods[0].checkpoint)
    return f"Tables 2, 6, 7: CMU, {options.split}", BODY, scores | PAPER


def _floor(options: argparse.Namespace, progress: Progress) -> tuple[str, tuple[str, ...], Scores]:
    """Table 3: stairs and ramps between terraces at -4 to 4 m."""
    store, names = recordings_of(options, "simulated_hillside")
    methods = [
        Method(f"floor {floor}", options.checkpoint, ("pipeline=mocap_every", f"pipeline.floor={floor}"))
        for floor in FLOORS
    ]
    run, pipeline = TRAINED["as in the paper"]
    path = options.runs / run / "checkpoints" / "best.ckpt"
    if path.is_file():
        methods += [
            Method(f"as in the paper, floor {floor}", str(path), (*pipeline, f"pipeline.floor={floor}"))
            for floor in ("fixed", "update")
        ]
    scores = {}
    for method in methods:
        bar = progress.add_task(method.name, total=len(names))
        scores[method.name] = aggregate(
            [floor_row(*pair) for pair in captures(method, store, names, lambda b=bar: progress.advance(b))]
        )
    both = (("paper: fixed", (9.19, 16.58, 12.35)), ("paper: update", (6.04, 7.19, 6.53)))
    paper = {name: {key: Summary(v, None, 1) for key, v in zip(FLOOR, values)} for name, values in both}
    return f"Table 3: hillsides, {options.split}", FLOOR, scores | paper


def _cues(options: argparse.Namespace, progress: Progress) -> tuple[str, tuple[str, ...], Scores]:
    """Table 4: the right wrist in the head camera's picture, at the frames that show it."""
    checkpoint_file(options.manifold)
    load_visual_cues(options.manifold)
    level = pipeline_of(Method("ours", options.checkpoint, ("pipeline=mocap_every", "pipeline.floor=fixed")))
    pipelines = {"cmu": level, "simulated": pipeline_of(Method("ours", options.checkpoint))}
    # Adam takes ten times as long: on the smaller data set alone.
    rows = (
        ("cmu", "edited", LatentSolver()),
        ("cmu", "edited by 500 Adam steps", LatentSolver("adam", 500)),
        ("simulated", "edited", LatentSolver()),
    )
    scores: Scores = {}
    for data, label, solver in rows:
        store, names = recordings_of(options, data)
        bar = progress.add_task(f"cues: {data}, {label}", total=len(names))
        pairs = []
        for name in names:
            pairs.append(cue_row(store.load(name), pipelines[data], options.manifold, solver))
            progress.advance(bar)
        before, after = ([pair[k] for pair in pairs if pair is not None] for k in (0, 1))
        if before:
            scores[f"{data}: estimated"] = aggregate(before)
            scores[f"{data}: {label}"] = aggregate(after)
            progress.console.print(f"{data}: {sum(row.frames for row in before)} frames show the wrist")
    both = (("paper: estimated", (11.91, 9.72, 8.04)), ("paper: edited", (5.55, 5.97, 6.65)))
    paper = {name: {key: Summary(v, None, 1) for key, v in zip(CUES, values)} for name, values in both}
    return f"Table 4: frames that show the right wrist, {options.split}", CUES, scores | paper


def _calibration(options: argparse.Namespace, progress: Progress) -> tuple[str, tuple[str, ...], Scores]:
    """Appendix C.2: planted frames, mounts, scales and clocks."""
    sessions = 3 if options.quick else options.sessions
    bar = progress.add_task("calibration", total=2 * sessions)
    scores = calibration_scores(sessions, lambda: progress.advance(bar))
    return f"Calibration: errors in {sessions} simulated sessions", tuple(GOALS), scores


PARTS = {"body": _body, "floor": _floor, "cues": _cues, "calibration": _calibration}
