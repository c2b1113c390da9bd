"""HMD² with head path, points and images on held-out people and places: Tables 6.1 to 6.10 of the thesis.

Every row captures whole recordings with every seed; ± is the deviation over seeds. Rows without a checkpoint are left
out, which is printed. Checkpoints come by name (checkpoints/) or path.
"""

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

from hmd2_runs import BASELINES, Case, Method, Result, run_method
from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table
from tabling import TRAINING, finite, new_table

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.models.checkpoint import checkpoint_file
from wearcap.recording import RecordingStore

COLUMNS = {
    "mpjpe_cm": "MPJPE",
    "hand_pe_cm": "hand",
    "upper_pe_cm": "upper",
    "lower_pe_cm": "lower",
    "p95_cm": "95 %",
    "fid": "FID",
    "diversity": "divers.",
    "physicality": "phys.",
    "floor_penetration_cm": "floor",
    "foot_skate_cm_s": "skate",
    "jitter_ratio": "jitter",
    "seam_ratio": "seam",
    **TRAINING,
}
PAPER = {
    "EgoEgo": (16.61, 34.64, 35.69, 20.15, 3.68, 2.43),
    "AvatarPoser (head)": (10.64, 21.51, 27.61, 12.99, 1.69, 4.21),
    "HMD² (h = 180)": (8.36, 16.64, 2.16, 15.74, 1.03, 1.03),
    "HMD² (h = 10)": (9.19, 17.67, 5.00, 15.23, 1.30, 1.19),
}
"""Thesis Table 6.1, on Nymeria: MPJPE, hand, FID, Diversity (truth 16.13), Physicality (truth 0.56), floor penetration."""
MODALITIES = {"full": "[points,images]", "w/o images": "[points]", "w/o points": "[images]", "head alone": "[]"}
TRAINED = {
    "EgoEgo-style": ("egoego_style", "baseline/egoego_style"),
    "EgoAllo-style": ("egoallo_style", "baseline/egoallo_style"),
    "AGRoL-style (head)": ("agrol_style", "baseline/agrol_style"),
    "AvatarPoser-style (head)": ("avatarposer_head", "pose_regressor"),
    "AvatarPoser-style (head and hands)": ("avatarposer_hands", "pose_regressor"),
}
"""Baselines: experiment and run, and pipeline. Each is trained by `wearcap train experiment=baseline/RUN data=hmd2
paths.run=RUNS/RUN`; its checkpoint of the lowest validation loss is captured with."""
STRIDES = (230, 180, 120, 60, 30, 10, 1)
STEPS = (2, 3, 5, 10, 20, 40, 80)
LOOKAHEAD = 20
"""Frames that our windows of the sweep look ahead; longer strides have no more than a window's room for it."""
WIDTH = 240


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--dataset",
        type=Path,
        default=Path("datasets/simulated_camera"),
        help="whose split is captured (datasets/cmu_surrounded: real motion, too short for FID)",
    )
    parser.add_argument(
        "--training",
        nargs="+",
        default=["datasets/simulated_camera", "datasets/cmu_surrounded"],
        help="data sets that mean pose and nearest window learn from",
    )
    parser.add_argument("--split", default="test", help="train, val or test")
    parser.add_argument("--seeds", type=int, default=8, help="repetitions (2 when quick)")
    parser.add_argument("--recordings", type=int, help="no more than so many of the split")
    parser.add_argument("--checkpoint", default="hmd2", help="the full model")
    parser.add_argument(
        "--runs", type=Path, default=Path("outputs/train"), help="folder of the baselines' trainings, by name"
    )
    parser.add_argument(
        "--separate",
        nargs="*",
        default=[],
        metavar="NAME=CHECKPOINT",
        help="rows trained by themselves, such as head=…",
    )
    parser.add_argument("--realism", default="motion_autoencoder", help="the motion autoencoder")
    parser.add_argument("--sweep-recordings", type=int, default=6, help="recordings of the sweeps over h and steps")
    parser.add_argument("--sweep-seeds", type=int, default=2, help="repetitions of the sweeps")
    parser.add_argument(
        "--strides",
        type=int,
        nargs="*",
        default=STRIDES,
        help="h of Table 6.5 (h = 1 takes ten times as long as all others together)",
    )
    parser.add_argument("--steps", type=int, nargs="*", default=STEPS, help="steps of Table 6.7")
    parser.add_argument("--device", default="cpu", help="device that captures")
    parser.add_argument("--jobs", type=int, default=2, help="rows at a time")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the tables; returns the file."""
    case = _case(options)
    console = Console(width=WIDTH)
    short = replace(case, names=case.names[: options.sweep_recordings], seeds=case.seeds[: options.sweep_seeds])
    sweeps = (
        []
        if options.quick
        else [
            ("Table 6.5: latency", short, [method for h in options.strides for method in _latencies(options, h)]),
            (
                "Table 6.7: steps",
                short,
                [_ours(options, f"{n} steps", f"pipeline.sampling.steps={n}") for n in options.steps],
            ),
        ]
    )
    jobs = [("Tables 6.1 and 6.3", case, _methods(options, console)), *sweeps]
    results = Parallel(n_jobs=options.jobs)(
        delayed(run_method)(method, where) for _, where, methods in jobs for method in methods
    )
    found: dict[str, list[Result]] = {}
    for title, _, methods in jobs:
        found[title] = [result for result in results[: len(methods)] if result is not None]
        results = results[len(methods) :]
        console.print(_table(f"{title} ({case.dataset.name}, {options.split})", found[title]))
    console.print(_paper())
    for metric, title in (
        ("mpjpe_cm", "MPJPE (cm)"),
        ("hand_pe_cm", "hand error (cm)"),
        ("lower_pe_cm", "lower body (cm)"),
    ):
        console.print(
            _activities(f"Tables 6.8–6.10: {title} by what was mostly done", found["Tables 6.1 and 6.3"], metric)
        )
    path = options.output / f"hmd2_{case.dataset.name}.json"
    tree = {title: [asdict(result) for result in rows] for title, rows in found.items()}
    facts = {
        **about,
        "dataset": str(case.dataset),
        "split": options.split,
        "seeds": len(case.seeds),
        "recordings": len(case.names),
    }
    write_text(path, json.dumps(finite({"about": facts, "tables": tree}), indent=1) + "\n")
    return path


def _case(options: argparse.Namespace) -> Case:
    if not (options.dataset / "manifest.json").is_file():
        raise WearcapError(
            "no such data set",
            where=options.dataset,
            fix="Run: wearcap prepare simulated camera=true output=datasets/simulated_camera",
        )
    names = RecordingStore.open(options.dataset).names(options.split)
    names = names[: 3 if options.quick else options.recordings]
    seeds = tuple(range(2 if options.quick else options.seeds))
    realism = options.realism if _exists(options.realism) else None
    return Case(options.dataset, tuple(names), seeds, tuple(options.training), realism, options.device)


def _exists(checkpoint: str) -> bool:
    try:
        return checkpoint_file(checkpoint).is_file()
    except WearcapError:
        return False


def _ours(options: argparse.Namespace, name: str, *overrides: str, pipeline: str = "hmd2") -> Method:
    return Method(name, options.checkpoint, (f"pipeline={pipeline}", "pipeline.runtime=auto", *overrides))


def _latencies(options: argparse.Namespace, h: int) -> list[Method]:
    """A stride of Table 6.5 as in the paper, and as ours, in as many steps."""
    ahead = min(LOOKAHEAD, 240 - h)
    both = (f"pipeline.overlap.stride={h}", "pipeline.sampling.steps=5", "pipeline.live=true")
    return [
        _ours(options, f"h = {h}, the paper's", *both, pipeline="paper/hmd2"),
        _ours(options, f"h = {h}", *both, "pipeline.overlap.fade=10", "pipeline.overlap.lookahead=0"),
        _ours(
            options, f"h = {h}, {ahead} ahead", *both, "pipeline.overlap.fade=10", f"pipeline.overlap.lookahead={ahead}"
        ),
    ]


def _methods(options: argparse.Namespace, console: Console) -> list[Method]:
    """Rows of the first table; those whose checkpoint is not there are named and left out."""
    trained = [
        Method(name, str(options.runs / run / "checkpoints" / "best.ckpt"), (f"pipeline={pipeline}",))
        for name, (run, pipeline) in TRAINED.items()
    ]
    ablations = [_ours(options, name, f"pipeline.use={use}") for name, use in MODALITIES.items()]
    separate = [
        Method(f"{name}, trained by itself", checkpoint)
        for name, _, checkpoint in (row.partition("=") for row in options.separate)
    ]
    wanted = [
        *(Method(name) for name in BASELINES),
        *trained,
        *ablations,
        *separate,
        _ours(options, "full, the paper's windows", pipeline="paper/hmd2"),
        _ours(options, "full, one step to the mean", pipeline="ablation/hmd2_mean"),
    ]
    there = [method for method in wanted if method.checkpoint is None or _exists(method.checkpoint)]
    for method in wanted:
        if method not in there:
            console.print(f"left out: {method.name} (no checkpoint {method.checkpoint!r})", soft_wrap=True)
    return there


def _table(title: str, results: list[Result]) -> Table:
    table = new_table(title, ["", *COLUMNS.values()])
    for result in results:
        cells = [str(result.scores[key]) if key in result.scores else "–" for key in COLUMNS]
        table.add_row(result.method, *cells)
    if results:
        first = results[0].scores
        truth = {"physicality": "truth_physicality", "diversity": "truth_diversity"}
        table.add_row("truth", *(f"{first[truth[key]].mean:.2f}" if truth.get(key) in first else "" for key in COLUMNS))
    return table


def _paper() -> Table:
    table = new_table("the paper, on Nymeria", ["", "MPJPE", "hand", "FID", "divers.", "phys.", "floor"])
    for name, values in PAPER.items():
        table.add_row(name, *(f"{value:.2f}" for value in values))
    return table


def _activities(title: str, results: list[Result], metric: str) -> Table:
    names = sorted({activity for result in results for activity in result.activities})
    table = new_table(title, ["", *(name[:14] for name in names)])
    for result in results:
        row = [result.activities[name][metric].mean if name in result.activities else None for name in names]
        table.add_row(result.method, *("–" if value is None else f"{value:.1f}" for value in row))
    return table
