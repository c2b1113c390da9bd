"""A solver of ours against Adam at its best schedule, each until it has reached the same energy."""

import math
import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from benchmarks.speed.figures import figure

WITHIN = 1.001
"""An energy is reached within a thousandth."""


class Schedule(NamedTuple):
    """How Adam runs."""

    rate: float
    decay: int | None
    """Steps over which the rate decays to zero as a cosine; None: it is constant."""
    dtype: torch.dtype = torch.float32

    def at(self, step: int) -> float:
        """The rate at a step."""
        return self.rate if self.decay is None else self.rate * 0.5 * (1 + math.cos(math.pi * step / self.decay))

    def __str__(self) -> str:
        decay = "constant" if self.decay is None else f"to zero over {self.decay} steps"
        return f"{self.rate:g} {decay}{', double precision' if self.dtype == torch.float64 else ''}"


class Run(NamedTuple):
    """A run of one side until a target."""

    seconds: float
    energy: float
    steps: int


def least(runs: Sequence[Run]) -> float:
    """The least energy of a run's states."""
    return min(run.energy for run in runs)


def reach(runs: Sequence[Run], target: float) -> tuple[float, float]:
    """Order of Adam's schedules: the energy where the target is not reached, then the seconds until it is."""
    return next(((0.0, run.seconds) for run in runs if run.energy <= target * WITHIN), (least(runs), 0.0))


def compared(
    name: str, pairs: Sequence[tuple[Run, Run]], target: float, schedule: Schedule, goal: float | None
) -> dict[str, Any]:
    """The figure of runs (ours, Adam's) in turns until a target; its ratio is Adam's time over ours."""
    (ours, theirs), *_ = pairs
    value, baseline = (statistics.median(run.seconds for run in side) for side in zip(*pairs))
    unit = (
        f"s (energy {ours.energy:.4f} after {ours.steps} iterations against {theirs.energy:.4f} after {theirs.steps} "
    )
    unit += f"of Adam at {schedule}"
    for who, run in (("Adam", theirs), ("ours", ours)):
        if run.energy > target * WITHIN:
            unit += f"; {who} does not reach {target:.4f}: its time is a lower bound"
    return figure(name, value, unit + ")", baseline, baseline / value, goal)
