"""Contact prediction of a minute of poses at 60 Hz, features included, on all cores: seconds.

value: median seconds of ours, both classes; baseline: the minute itself. ratio = baseline / value, to be at least
`goal`, which is a minute in 0.15 s.
"""

from benchmarks.speed import planted
from benchmarks.speed.contact_sequence_vs_window import SECONDS, predictors
from benchmarks.speed.figures import figure, in_turns


def measure(seconds: float = SECONDS, rounds: int = 15) -> list[dict]:
    motion = planted.swinging("swing", seconds, 0).motion
    assert motion is not None
    ours, _ = predictors()
    (value,) = in_turns([lambda: ours(motion)], rounds)
    return [figure("contact_seconds_per_minute", value, "s", seconds, seconds / value, SECONDS / 0.15)]
