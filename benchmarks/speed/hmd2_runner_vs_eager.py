"""HMD² online (h = 10, batch 1, CPU): what the runner wins over a plain eager loop at equal steps and precision.

All sides stream the same walk, push by push in turns: points, embeddings, windows, all steps, anchoring; value and
baseline are frames per second (median push), ratio = value / baseline, to be at least `goal`. Three figures for each
size of the model, each of which changes one thing alone:

`hmd2_runner_vs_eager`: the runner of `pipeline=hmd2_online` against the whole network called eagerly at each step,
both with five steps in float32. The goal of 3 is out of reach on a CPU whose matrix products are the limit: a step is
0.37 (small) and 1.36 GFLOP (full) of them, which the runner does at the rate of a bare product of PyTorch's on the same
core (measured on one: 65 and 82 against 68 and 75 GFLOP/s), and eager at a little over half of it.
`hmd2_precision_in_runner`: the configured number format (int8 with ONNX Runtime) against float32, five steps.
`hmd2_steps_in_runner`: the configured one step against the paper's twenty, the configured format. What fewer steps cost is
in the table of steps (`python benchmarks/tables.py hmd2`, Table 6.7).
"""

from dataclasses import fields, replace
from typing import Any

from benchmarks.speed.figures import per_second
from benchmarks.speed.online import Streamed, pipeline_of
from wearcap.diffusion.process import step_levels
from wearcap.systems.hmd2.model import StepRunner
from wearcap.systems.hmd2.pipeline import HMD2

PAPERS_STEPS, COMPARED_STEPS = 20, 5


class _Loop(StepRunner):
    """A sampler's loop as one writes it first: the whole network at each step."""

    def __init__(self, net, levels):
        self.net, self.levels, self.runtime = net, levels, "eager"

    def __call__(self, number, x_t, encoded, valid, last=None):
        return self.net(x_t, self.levels[number].expand(len(x_t), 1), encoded, valid, last)


class _Plain(HMD2):
    def prepare(self) -> None:
        super().prepare()
        self._steps = _Loop(self.model.net, step_levels(self.sampling.steps, self.sampling.spacing)[:-1])


def measure(pushes: int = 15, sizes: tuple[str, ...] = ("full", "small")) -> list[dict]:
    figures = []
    for size in sizes:
        configured = pipeline_of(size)
        several, more = (replace(configured.sampling, steps=steps) for steps in (COMPARED_STEPS, PAPERS_STEPS))
        wide = {"precision": "float32", "sampling": several}
        ours, narrow, runner, eager, long = sides = [
            Streamed(pipeline).fill()
            for pipeline in (
                configured,
                _with(HMD2, configured, sampling=several),
                _with(HMD2, configured, **wide),
                _with(_Plain, configured, runtime="eager", **wide),
                _with(HMD2, configured, sampling=more),
            )
        ]
        for _ in range(pushes):
            for side in sides:
                side.step()
        ending = "" if size == "full" else f"_{size}"
        for name, value, baseline, goal in (
            ("hmd2_runner_vs_eager", runner, eager, 3.0),
            ("hmd2_precision_in_runner", narrow, runner, None),
            ("hmd2_steps_in_runner", ours, long, None),
        ):
            figures.append(per_second(name + ending, value.frames_per_second, baseline.frames_per_second, goal))
    return figures


def _with(kind: type[HMD2], pipeline: HMD2, **changes: Any) -> HMD2:
    return kind(**{entry.name: getattr(pipeline, entry.name) for entry in fields(pipeline)} | changes)
