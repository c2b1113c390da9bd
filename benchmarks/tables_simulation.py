"""How far simulated people differ from CMU's: gait statistics of straight walking, and a discriminator.

The discriminator is a small network that sees two seconds of head and wrist paths and predicts which they are from; it is
judged on people it has not seen. 50 % means that it cannot tell.
"""

import argparse
import json
from pathlib import Path

import torch
from discriminator import held_out_accuracy
from gait_statistics import Clip, clip_of, walking_windows
from rich import print as show
from rich.table import Table
from scipy.stats import ks_2samp

from wearcap.files import write_text
from wearcap.recording import RecordingStore


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--simulated", default="datasets/simulated", help="prepared data set of simulated people")
    parser.add_argument("--cmu", default="datasets/cmu", help="prepared data set of CMU")
    parser.add_argument("--seeds", type=int, default=5, help="trainings of the discriminator (2 when quick)")


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write both tables; returns the path of the JSON file."""
    clips = {
        name: _clips(root, options.quick) for name, root in (("simulated", options.simulated), ("cmu", options.cmu))
    }
    statistics = _compared(walking_windows(clips["simulated"]), walking_windows(clips["cmu"]))
    show(_statistics_table(statistics))
    seeds, steps = (2, 150) if options.quick else (options.seeds, 600)
    accuracy = {
        which: held_out_accuracy(clips["simulated"], clips["cmu"], which == "walking", range(seeds), steps)
        for which in ("walking", "all activities")
    }
    halves = _halves(clips["cmu"])
    accuracy["control: CMU against CMU"] = held_out_accuracy(*halves, False, range(seeds), steps)
    show(_accuracy_table(accuracy))
    path = options.output / "simulation.json"
    tree = {"about": about, "walking": statistics, "discriminator": accuracy}
    write_text(path, json.dumps(tree, indent=1) + "\n")
    return path


def _clips(root: str, quick: bool) -> list[Clip]:
    store = RecordingStore.open(root)
    names = [name for name in store.names() if store.entries[name].duration_s >= 2]
    names = names[:: max(1, len(names) // 60)] if quick else names
    return [clip_of(store.load(name)) for name in names]


def _halves(clips: list[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Every other person: what a discriminator reaches where there is nothing to find."""
    people = sorted({clip.person for clip in clips})
    first = set(people[::2])
    return [c for c in clips if c.person in first], [c for c in clips if c.person not in first]


def _compared(simulated: dict[str, torch.Tensor], cmu: dict[str, torch.Tensor]) -> dict[str, dict[str, float]]:
    """Mean and spread of every statistic on both sides, and the Kolmogorov–Smirnov distance between them."""
    rows = {}
    for name in cmu:
        a, b = simulated[name], cmu[name]
        if min(len(a), len(b)) < 2:
            continue
        rows[name] = {
            "simulated_mean": a.mean().item(),
            "simulated_std": a.std().item(),
            "simulated_windows": len(a),
            "cmu_mean": b.mean().item(),
            "cmu_std": b.std().item(),
            "cmu_windows": len(b),
            "ks_distance": float(ks_2samp(a.numpy(), b.numpy())[0]),
        }
    return rows


def _statistics_table(statistics: dict[str, dict[str, float]]) -> Table:
    first = next(iter(statistics.values()), {"simulated_windows": 0, "cmu_windows": 0})
    table = Table(title="Straight walking, windows of 2 s")
    for name in (
        "statistic",
        f"simulated ({first['simulated_windows']})",
        f"CMU ({first['cmu_windows']})",
        "Kolmogorov–Smirnov",
    ):
        table.add_column(name, justify="left" if name == "statistic" else "right")
    for name, row in statistics.items():
        sides = [f"{row[side + '_mean']:.2f} ± {row[side + '_std']:.2f}" for side in ("simulated", "cmu")]
        table.add_row(name, *sides, f"{row['ks_distance']:.2f}")
    return table


def _accuracy_table(accuracy: dict[str, dict]) -> Table:
    table = Table(title="Discriminator: accuracy on held-out people (50 % is chance)")
    for name in ("windows", "accuracy", "seeds", "held-out windows"):
        table.add_column(name, justify="left" if name == "windows" else "right")
    for which, found in accuracy.items():
        spread = f"{100 * found['mean']:.1f} ± {100 * found['std']:.1f} %"
        table.add_row(which, spread, str(len(found["accuracies"])), str(found["held_out_windows"]))
    return table
