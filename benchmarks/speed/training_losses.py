"""Losses of trainings with windows drawn in batches and drawn one by one, otherwise alike: one JSON line per experiment.

    python -m benchmarks.speed.training_losses [--experiments NAME …] [--steps 500] [--seeds 3] [--datasets DIR]

Each seed begins with the same weights and statistics on both sides. Curves are means over every 50 steps: of the seeds
("mean"), and their standard deviation ("spread"). "apart": the difference of both means by its standard error, at every 50
steps; within ±2 at 19 of 20 if the losses are the same. "validation": the losses at the end on the same windows, by seed.
"""

import argparse
import json
import statistics
from pathlib import Path

import torch

from benchmarks.speed.training_paths import EXPERIMENTS, both, config_of, first_weights, has_data, threads, trained

EVERY = 50


def losses(experiment: str, datasets: Path, steps: int, seeds: int, *overrides: str) -> dict:
    """Curves of an experiment, drawn in batches ("now") and one by one ("before")."""
    curves: dict[str, list[list[float]]] = {"now": [], "before": []}
    ends: dict[str, list[float]] = {"now": [], "before": []}
    every = min(EVERY, steps)
    for seed in range(seeds):
        given = f"trainer.max_steps={steps}", f"seed={seed}", f"data.loading.steps_per_epoch={steps}"
        config = config_of(experiment, datasets, *given, *overrides)
        sides = dict(zip(("now", "before"), both(config)[:2]))
        state = first_weights(config, sides["now"])
        for name, data in sides.items():
            clock = trained(config, data, state).clock
            loss = torch.stack(clock.losses)[: steps // every * every]
            curves[name].append(loss.float().reshape(-1, every).mean(1).tolist())
            ends[name].append(clock.validations[-1][1])
    found = {name: _curve(each) | {"validation": ends[name]} for name, each in curves.items()}
    return {"experiment": experiment, "every": every, "seeds": seeds, **found, "apart": _apart(*curves.values())}


def _curve(curves: list[list[float]]) -> dict[str, list[float]]:
    return {
        "mean": [statistics.fmean(values) for values in zip(*curves)],
        "spread": [statistics.stdev(values) if len(values) > 1 else 0.0 for values in zip(*curves)],
    }


def _apart(now: list[list[float]], before: list[list[float]]) -> list[float]:
    """Differences of the means by their standard errors."""
    a, b = torch.tensor(now), torch.tensor(before)
    error = ((a.var(0, correction=0) + b.var(0, correction=0)) / max(1, len(a) - 1)).sqrt()
    return ((a.mean(0) - b.mean(0)) / error.clamp_min(1e-9)).tolist()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", nargs="+", default=EXPERIMENTS, metavar="NAME")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--datasets", type=Path, default=Path("datasets"), help="folder of the data sets")
    parser.add_argument("--cores", type=int, help="threads; default: PyTorch's own")
    parser.add_argument("--overrides", nargs="*", default=[], help="further ones of wearcap train")
    options = parser.parse_args(arguments)
    with threads(options.cores):
        for experiment in options.experiments:
            if has_data(config_of(experiment, options.datasets, *options.overrides)):
                found = losses(experiment, options.datasets, options.steps, options.seeds, *options.overrides)
                print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
