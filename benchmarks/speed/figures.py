"""What a benchmark returns, and the clocks of both of its sides."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any


def figure(name: str, value: float, unit: str, baseline: float, ratio: float, goal: float | None) -> dict[str, Any]:
    """A figure, as `run.py` prints it."""
    return {"name": name, "value": value, "unit": unit, "baseline": baseline, "ratio": ratio, "goal": goal}


def per_second(name: str, value: float, baseline: float, goal: float | None) -> dict[str, Any]:
    """A figure of frames per second; its ratio is ours over the baseline."""
    return figure(name, value, "frames/s", baseline, value / baseline, goal)


def seconds(run: Callable[[], object]) -> float:
    """Time (s) of one call."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def in_turns(sides: Sequence[Callable[[], object]], rounds: int) -> list[float]:
    """Median time (s) of each side's call; in each round all take their turn, and the round before the first is not counted."""
    times = [[seconds(side) for side in sides] for _ in range(rounds + 1)][1:]
    return [statistics.median(side) for side in zip(*times)]


def rate(run: Callable[[], object], count: int, repeats: int) -> float:
    """`count` per second of a call: the median of some calls."""
    return count / statistics.median(seconds(run) for _ in range(repeats))
