"""ECHO on a GPU, the paper's size without guidance: milliseconds per frame.

Drawn weights; the conveyor of `pipeline=ablation/echo_conveyor` (two steps for every frame that enters), compiled with CUDA graphs in float32.
A frame is everything from its conditions to body, object and contacts in the world: one wearer alone, and eight side by
side, of whom each has an eighth of the time. baseline: the paper's 13.73 ms on an RTX 4090; ratio = baseline / value, to
be at least `goal` (1.4 ms, on an H200). Without a CUDA device it is left out.
"""

import time

import torch
from echo_runs import conditions_of, figure, pipeline_of
from online import without_cuda

from wearcap.systems.echo.pipeline import Echo

PAPER_MS = 13.73
GOAL_MS = 1.4


def measure(frames: int = 200, items: tuple[int, ...] = (1, 8), device: str = "cuda") -> list[dict]:
    if device == "cuda" and without_cuda("echo_ms_per_frame"):
        return []
    runtime = "compile" if device == "cuda" else "eager"
    pipeline = pipeline_of("ablation/echo_conveyor", device, "full/echo", runtime=runtime, guided=False)
    rows = []
    for count in items:
        value = _milliseconds(pipeline, frames, count)
        name = "echo_ms_per_frame" + (f"_{count}_wearers" if count > 1 else "")
        rows.append(figure(name, value, "ms", PAPER_MS, PAPER_MS / value, PAPER_MS / GOAL_MS))
    return rows


@torch.no_grad()
def _milliseconds(pipeline: Echo, frames: int, items: int) -> float:
    pipeline.prepare()
    conditioning, filling = conditions_of(pipeline, items, (frames + 90) / pipeline.fps), 90
    queue = pipeline.queue([pipeline.model.skeleton] * items, list(range(items)), [{}] * items, [[]] * items)
    for number in range(filling):
        queue.push(conditioning.frames(slice(number, number + 1)))
    begin = time.perf_counter()
    for number in range(filling, filling + frames):
        queue.push(conditioning.frames(slice(number, number + 1)))
    return 1000 * (time.perf_counter() - begin) / frames / items
