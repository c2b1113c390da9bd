"""HMD2 on the head path alone: the paper's row "without points, without images", on the data at hand.

Without --checkpoint the rows are trained first, once per seed, with the configuration of their experiment.
"""

import argparse
import json
import re
from pathlib import Path

from rich import print as show

from wearcap.cli import evaluate, train
from wearcap.cli.conf import compose
from wearcap.metrics.table import Scores, Summary, rich_table, truth_row, write_scores

OURS = ("experiment=motion_diffusion_head",)
ABLATIONS = {
    "the paper's frame, losses and draws": ("experiment=paper/motion_diffusion_head",),
    "noise levels drawn uniformly": (*OURS, "model.level_tilt=0"),
    "all windows drawn alike": (*OURS, "data.dataset.balance=1"),
    "condition without context": (*OURS, "model.net.context=0"),
}
PAPER: Scores = {
    "HMD2's paper, on Nymeria": {"mpjpe_cm": Summary(9.28, None, 1), "hand_pe_cm": Summary(19.47, None, 1)}
}
COLUMNS = (
    "mpjpe_cm",
    "hand_pe_cm",
    "lower_pe_cm",
    "upper_pe_cm",
    "p95_cm",
    "jitter_ratio",
    "foot_skate_cm_s",
    "physicality",
    "jitter_m_s3",
    "floor_penetration_cm",
)
QUICK = (
    "trainer.max_steps=300",
    "data.loading.steps_per_epoch=100",
    "data.loading.batch_size=16",
    "callbacks.average.decay=0.98",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", default="cmu", help="config of the data: cmu, simulated, hmd2_head")
    parser.add_argument("--datasets", default="datasets", help="folder of the prepared data sets")
    parser.add_argument("--checkpoint", nargs="+", help="our checkpoints, one per seed, instead of training")
    parser.add_argument("--seeds", type=int, default=3, help="trainings per row (1 when quick)")
    parser.add_argument("--device", default="cpu", help="device that captures")
    parser.add_argument("--no-ablations", action="store_true", help="ours and the baselines alone")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the table; returns its path."""
    checkpoints = options.checkpoint or _trained("ours", OURS, options)
    scores = {**_evaluated(checkpoints, options, "hmd2", baselines=True)}
    scores["wearcap, sampled in five steps"] = _evaluated(checkpoints, options, "ablation/hmd2_sampled")["wearcap"]
    if not options.no_ablations:
        for row, overrides in ABLATIONS.items():
            scores[row] = _evaluated(_trained(row, overrides, options), options, "hmd2")["wearcap"]
        if not options.quick:
            scores["wearcap, latency 0.17 s"] = _evaluated(checkpoints, options, "hmd2_online")["wearcap"]
    scores["truth"] = truth_row(scores["wearcap"])
    path = options.output / "hmd2_head.json"
    show(rich_table(f"HMD2, head path alone ({options.data})", {**scores, **PAPER}, COLUMNS))
    facts = {"data": options.data, "quick": str(options.quick), "checkpoints": " ".join(map(str, checkpoints))}
    write_scores(path, {**scores, **PAPER}, {**about, **facts})
    return path


def _trained(row: str, changes: tuple[str, ...], options: argparse.Namespace) -> list[str]:
    """Checkpoints of one row, one per seed."""
    found = []
    for seed in range(1 if options.quick else options.seeds):
        run = options.output / "runs" / f"{re.sub(r'[^a-z]+', '_', row)}_{options.data}_{seed}"
        overrides = [
            *changes,
            f"data={options.data}",
            f"seed={seed}",
            f"paths.datasets={options.datasets}",
            f"paths.run={run}",
            "callbacks.capture=null",
            *(QUICK if options.quick else ()),
        ]
        train.train(compose("train", overrides))
        found.append(str(run / "checkpoints" / "last.ckpt"))
    return found


def _evaluated(checkpoints: list[str], options: argparse.Namespace, pipeline: str, baselines: bool = False) -> Scores:
    """Scores of whole recordings of the test split, over trainings and sampling seeds."""
    overrides = [
        f"checkpoint={json.dumps(checkpoints)}",
        f"pipeline={pipeline}",
        f"baselines={baselines}",
        f"seeds={[0] if options.quick else [0, 1, 2]}",
        f"device={options.device}",
        f"output={options.output / 'runs' / 'last_evaluation.json'}",
    ]
    return evaluate.run(compose("evaluate", overrides))
