"""ECHO online on this machine's CPU, frame by frame: frames per second, everything included.

Head and wrists at 30 Hz go in one by one, poses, object and contacts come out; a box is the active object every other two
seconds. `pipeline=echo_online` (0.6 s behind, a window in one step for every four frames), the same in eager PyTorch, and
in the same runtime the conveyor (`pipeline=ablation/echo_conveyor`: 1.8 s behind, two steps per frame) without guidance.
Median of several runs of a second or more, once the window is full. baseline: real time, 30; ratio = value / baseline, to
be at least `goal`.
"""

from dataclasses import replace

from benchmarks.speed.echo_runs import frames_per_second, pipeline_of
from benchmarks.speed.figures import per_second

REAL_TIME = 30.0


def measure(frames: int = 150, repeats: int = 5) -> list[dict]:
    online = pipeline_of("echo_online")
    conveyor = pipeline_of("ablation/echo_conveyor", runtime=online.runtime, guided=False)
    rows = {
        "echo_online_small_fps": online,
        "echo_online_small_eager_fps": replace(online, runtime="eager"),
        "echo_conveyor_small_fps": conveyor,
    }
    return [
        per_second(name, frames_per_second(pipeline, frames, repeats), REAL_TIME, 1.0)
        for name, pipeline in rows.items()
    ]
