"""HMD² online on this machine's CPU (h = 10, batch 1), full model: frames per second, everything included.

The steps, runtime and precision of `pipeline=hmd2_online`; median push of a walk among points with embeddings at 30 Hz.
baseline: real time, 60; ratio = value / baseline, to be at least `goal` (60 frames/s on two cores).
"""

from benchmarks.speed.figures import per_second
from benchmarks.speed.online import frames_per_second, pipeline_of


def measure(pushes: int = 30) -> list[dict]:
    value = frames_per_second(pipeline_of("full"), pushes)
    return [per_second("hmd2_online_full_fps", value, 60.0, 1.0)]
