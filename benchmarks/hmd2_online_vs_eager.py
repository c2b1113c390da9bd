"""HMD² online (h = 10, batch 1, CPU) against a plain eager float32 loop of 20 steps of the same model.

Both stream the same walk, push by push in turns: points, embeddings, windows, all steps, hanging. ours: the steps,
runtime and precision of `pipeline=hmd2_online`. value and baseline: frames per second (median push) of the full model;
ratio = value / baseline, to be at least `goal`. The second figure is the small model.
"""

from dataclasses import fields, replace

from online import Streamed, figure, pipeline_of

from wearcap.diffusion.process import step_levels
from wearcap.systems.hmd2.model import StepRunner
from wearcap.systems.hmd2.pipeline import HMD2

STEPS = 20


class _Loop(StepRunner):
    """A sampler's loop as one writes it first: the whole network at each step."""

    def __init__(self, net, levels):
        self.net, self.levels, self.runtime = net, levels, "eager"

    def __call__(self, number, x_t, encoded, valid, last=None):
        return self.net(x_t, self.levels[number].expand(len(x_t), 1), encoded, valid, last)


def measure(pushes: int = 15) -> list[dict]:
    figures = []
    for size in ("full", "small"):
        ours = pipeline_of(size)
        ours, plain = Streamed(ours).fill(), Streamed(_plain(ours)).fill()
        for _ in range(pushes):
            ours.step()
            plain.step()
        name = "hmd2_online_vs_eager" + ("" if size == "full" else "_small")
        figures.append(figure(name, ours.frames_per_second, plain.frames_per_second, 5.0))
    return figures


class _Plain(HMD2):
    def prepare(self) -> None:
        super().prepare()
        self._steps = _Loop(self.model.net, step_levels(self.sampling.steps)[:-1])


def _plain(pipeline: HMD2) -> HMD2:
    given = {entry.name: getattr(pipeline, entry.name) for entry in fields(pipeline)}
    sampling = replace(pipeline.sampling, steps=STEPS, spacing=1.0)
    return _Plain(**given | {"sampling": sampling, "runtime": "eager", "precision": "float32"})
