"""ECHO online on this machine's CPU, frame by frame: frames per second, everything included.

Head and wrists at 30 Hz go in one by one, poses, object and contacts come out; a box is the active object every other two
seconds. Runtime and steps of `pipeline=echo_online` (0.6 s behind, one step per frame), and in the same runtime those of
`pipeline=echo` (1.8 s behind, two steps per frame) without guidance; the first in eager PyTorch, too. Median of several
runs of a second or more, once the window is full. baseline: real time, 30; ratio = value / baseline, to be at least `goal`.
"""

from dataclasses import replace

from echo_runs import figure, frames_per_second, pipeline_of

REAL_TIME = 30.0


def measure(frames: int = 150, repeats: int = 5) -> list[dict]:
    online = pipeline_of("echo_online")
    offline = pipeline_of("echo", runtime=online.runtime, guided=False)
    rows = {
        "echo_online_small_fps": online,
        "echo_online_small_eager_fps": replace(online, runtime="eager"),
        "echo_two_steps_small_fps": offline,
    }
    return [
        figure(name, value, "frames/s", REAL_TIME, value / REAL_TIME, 1.0)
        for name, pipeline in rows.items()
        for value in [frames_per_second(pipeline, frames, repeats)]
    ]
