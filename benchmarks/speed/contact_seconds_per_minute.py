"""Contact prediction of a minute of poses at 60 Hz, features included, on all cores: seconds.

value: median seconds of ours, both classes; baseline: the minute itself. ratio = baseline / value, to be at least
`goal`, which is a minute in 0.15 s.
"""

import statistics
import time

from benchmarks.speed import planted
from benchmarks.speed.contact_sequence_vs_window import SECONDS, predictors


def measure(seconds: float = SECONDS, rounds: int = 15) -> list[dict]:
    motion = planted.swinging("swing", seconds, 0).motion
    assert motion is not None
    ours, _ = predictors()
    ours(motion)
    spent = []
    for _ in range(rounds):
        begin = time.perf_counter()
        ours(motion)
        spent.append(time.perf_counter() - begin)
    value = statistics.median(spent)
    return [
        {
            "name": "contact_seconds_per_minute",
            "value": value,
            "unit": "s",
            "baseline": seconds,
            "ratio": seconds / value,
            "goal": SECONDS / 0.15,
        }
    ]
