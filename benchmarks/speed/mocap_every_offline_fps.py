"""MocapEvery on whole recordings, on this machine's CPU: frames per second, everything included.

Ten minutes at 30 Hz; windows of 40 frames advance by 20, one after the other, as the floor's state is carried from
window to window; PyTorch, then ONNX Runtime. baseline: real time, 30; ratio = value / baseline, to be at least `goal` (3000 frames/s).
"""

from dataclasses import replace

from benchmarks.speed.figures import per_second, rate
from benchmarks.speed.mocap_every_runs import pipeline_of, watched


def measure(duration_s: float = 600.0, repeats: int = 3) -> list[dict]:
    eager, recording = pipeline_of("mocap_every"), watched(duration_s)
    rows = []
    for name, pipeline in (
        ("mocap_every_offline_fps", eager),
        ("mocap_every_offline_onnx_fps", replace(eager, runtime="onnx")),
    ):
        frames = len(pipeline(recording))
        rows.append(per_second(name, rate(lambda run=pipeline: run(recording), frames, repeats), 30.0, 100.0))
    return rows
