"""Our image encoder on held-out people and places: whether hands are in the picture, and where."""

import argparse
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import track

from benchmarks.tables.tabling import new_table, write_tree
from wearcap.data.windows import Source
from wearcap.models.checkpoint import load_trained
from wearcap.systems.hmd2.egoview_frames import POINTS, EgoFrames
from wearcap.systems.hmd2.egoview_training import EgoView, view_scores

COLUMNS = {
    "hand_share": "hands seen",
    "hand_average_precision": "AP",
    "hand_error_cm": "hand (cm)",
    "hand_error_cm_of_mean": "mean's (cm)",
    "point_error_cm": "limbs (cm)",
    "point_error_cm_of_mean": "mean's (cm)",
}
EVERY = 4
"""Frames of the data are this far apart."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--datasets",
        nargs="+",
        default=["datasets/simulated_camera", "datasets/cmu_surrounded"],
        help="data sets with head cameras",
    )
    parser.add_argument("--split", default="test", help="train, val or test")
    parser.add_argument(
        "--checkpoint", required=True, help="of experiment=egoview: a run's .ckpt (a shared one has no heads)"
    )


@torch.inference_mode()
def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the table; returns the file."""
    system = load_trained(options.checkpoint)[0].eval()
    assert isinstance(system, EgoView)
    table = new_table(f"Hands in the head camera's pictures, {options.split} split", ["", *COLUMNS.values()])
    rows = {}
    for root in options.datasets:
        frames = EgoFrames([Source(root)], options.split, every=EVERY * (10 if options.quick else 1))
        rows[root] = _scores(system, frames)
        table.add_row(Path(root).name, *(f"{rows[root][key]:.{1 if 'cm' in key else 3}f}" for key in COLUMNS))
    Console(width=120).print(table)
    path = options.output / "egoview.json"
    return write_tree(path, {"about": about, "datasets": rows})


def _scores(system: EgoView, frames: EgoFrames) -> dict[str, float]:
    predicted, truth = [], []
    for numbers in track(torch.arange(len(frames)).split(256), description="frames"):
        batch = frames.batch(numbers, numbers)
        predicted.append(system(system.pictures(batch)))
        truth.append((batch.point_cam, batch.visible))
    logits, places = (torch.cat(parts) for parts in zip(*predicted))
    point_cam, visible = (torch.cat(parts) for parts in zip(*truth))
    mean = system.normalizer.mean.unflatten(-1, (len(POINTS), 3)).expand_as(places)
    return view_scores(logits.sigmoid(), places, mean, point_cam, visible)
