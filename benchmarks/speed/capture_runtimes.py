"""Whole recordings captured in ONNX Runtime against PyTorch, on this machine's CPU.

ECHO and HMD² by a headset's walk, MocapEvery by two watches. value: frames per second of a capture with `runtime=onnx`, everything
but the start included; baseline: with `runtime=eager`, in turns. `capture_onnx_start_…`: seconds that the first capture takes longer,
in which the graphs are exported; baseline: seconds of a capture with eager. No goals: they decide the default runtime.
"""

import time
from functools import partial
from pathlib import Path
from typing import Any

import wearcap
from benchmarks.speed.figures import figure, in_turns
from benchmarks.speed.mocap_every_runs import watched
from wearcap.recording import Recording

WALK = Path(__file__).parents[2] / "examples" / "headset_walk.csv"


def measure(
    duration_s: float = 60.0, rounds: int = 3, systems: tuple[str, ...] = ("echo", "hmd2", "mocap_every")
) -> list[dict]:
    rows = []
    for name in systems:
        recording: Recording = watched(duration_s) if name == "mocap_every" else wearcap.read(WALK, height=1.68)
        eager: Any = wearcap.load(name, "pipeline.runtime=eager")
        onnx: Any = wearcap.load(name, "pipeline.runtime=onnx")
        began = time.perf_counter()
        frames = len(onnx(recording))
        start = time.perf_counter() - began
        slow, fast = in_turns([partial(eager, recording), partial(onnx, recording)], rounds)
        rows.append(figure(f"capture_onnx_fps_{name}", frames / fast, "frames/s", frames / slow, slow / fast, None))
        rows.append(figure(f"capture_onnx_start_{name}", start - fast, "s", slow, (start - fast) / slow, None))
    return rows
