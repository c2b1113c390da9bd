"""MocapEvery on whole recordings, on this machine's CPU: frames per second, everything included.

Ten minutes at 30 Hz; windows of 40 frames advance by 20, one after the other, as the floor's state is carried from
window to window. baseline: real time, 30; ratio = value / baseline, to be at least `goal` (3000 frames/s).
"""

import time

from mocap_every_runs import figure, pipeline_of, watched


def measure(duration_s: float = 600.0, repeats: int = 3) -> list[dict]:
    pipeline, recording = pipeline_of("mocap_every"), watched(duration_s)
    pipeline(recording)
    rates = []
    for _ in range(repeats):
        begin = time.perf_counter()
        frames = len(pipeline(recording))
        rates.append(frames / (time.perf_counter() - begin))
    return [figure("mocap_every_offline_fps", sorted(rates)[repeats // 2], 30.0, 100.0)]
