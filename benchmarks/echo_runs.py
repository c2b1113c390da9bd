"""Streams and batches for benchmarks of ECHO: the shared checkpoint, or its size with drawn weights, and walks with boxes."""

import sys
import time

import numpy as np
import torch
from hydra.utils import instantiate
from planted import swinging

from wearcap.body.skeleton import xsens23
from wearcap.cli.conf import compose, load_pipeline
from wearcap.models.checkpoint import shared_checkpoints
from wearcap.runtime.wearer import Wearer
from wearcap.scene.objects import Environment
from wearcap.systems.echo.observations import Scenario, batch_item_of
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.queue import Conditioning
from wearcap.systems.echo.stream import EchoStream
from wearcap.tracking.head_path import head_path
from wearsim.places.movables import make_movable

NAME = "echo"
FPS = 30.0
LAP_S = 20.0
"""The walk leads there and back, over and over."""
HELD_S = 2.0
"""For as long a box is the active object, and then none for as long."""


def pipeline_of(
    config_name: str,
    device: str = "cpu",
    experiment: str = NAME,
    overrides: tuple[str, ...] = (),
    runtime: str | None = None,
    guided: bool = True,
) -> Echo:
    """A pipeline config around the checkpoint of an experiment's name, or around drawn weights of its size, which is printed."""
    config = compose("capture", [f"pipeline={config_name}", "recording=none"]).pipeline
    config.runtime = runtime or config.runtime
    config.contacts.guidance = config.contacts.guidance if guided else None
    if experiment in shared_checkpoints() and not overrides:
        pipeline = load_pipeline(experiment, config, device)
        assert isinstance(pipeline, Echo)
        return pipeline
    torch.manual_seed(0)
    system = instantiate(compose("train", [f"experiment={experiment}", *overrides]).model, _convert_="all").eval()
    for parameter in system.net.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    count = sum(parameter.numel() for parameter in system.net.parameters()) / 1e6
    print(f"no checkpoint of {experiment!r}: drawn weights, {count:.1f} M parameters", file=sys.stderr)
    return instantiate(config, _convert_="all")(**system.pipeline_parts(), device=device)


class Streamed:
    """A session that is fed a walk at 30 Hz, of one who takes up a box and lays it down every few seconds."""

    def __init__(self, pipeline: Echo):
        box = make_movable("box", "box", np.random.default_rng(0)).object
        self.session = EchoStream(pipeline, Wearer(xsens23(), floor_m=0.0), Environment((box,)))
        self.number, self.outputs = 0, 0
        motion = swinging("walk", LAP_S / 2, 0, fps=FPS).motion
        assert motion is not None
        self._lap = [
            [T[k] for k in (*range(len(motion)), *reversed(range(len(motion))))]
            for T in (motion.joint(name) for name in ("head", "left_wrist", "right_wrist"))
        ]

    def step(self) -> None:
        """One moment: what is tracked goes in, what is final comes out."""
        moment, place = self.number / FPS, self.number % len(self._lap[0])
        if self.number % round(HELD_S * FPS) == 0:
            observation = self.number % round(2 * HELD_S * FPS) == 0
            self.session.activate("box" if observation else None, moment)
        head, left, right = (poses[place] for poses in self._lap)
        self.session.wrist("left_wrist", moment, left)
        self.session.wrist("right_wrist", moment, right)
        self.session.head(moment, head)
        motion = self.session.poses()
        self.outputs += 0 if motion is None else len(motion)
        self.number += 1

    def fill(self) -> "Streamed":
        """Until the window is full, and what is compiled is."""
        for _ in range(2 * self.session.pipeline.model.net.window):
            self.step()
        return self


def frames_per_second(pipeline: Echo, frames: int, repeats: int) -> float:
    """Of a session whose window is full, everything included; the median of some runs of as many frames."""
    stream, rates = Streamed(pipeline).fill(), []
    for _ in range(repeats):
        begin = time.perf_counter()
        for _ in range(frames):
            stream.step()
        rates.append(frames / (time.perf_counter() - begin))
    return sorted(rates)[repeats // 2]


def conditions_of(pipeline: Echo, items: int, duration_s: float) -> Conditioning:
    """Conditions of several walks of a human alone, as one batch."""
    reader, parts = pipeline.reader(), []
    for seed in range(items):
        recording = swinging(f"walk_{seed}", duration_s, seed, fps=FPS)
        path = head_path(recording, pipeline.model.skeleton, pipeline.fps)
        parts.append(batch_item_of(Scenario(recording), path, reader).conditioning)
    return Conditioning(*(torch.cat(fields) for fields in zip(*parts)))


def figure(name: str, value: float, unit: str, baseline: float, ratio: float, goal: float) -> dict:
    return {"name": name, "value": value, "unit": unit, "baseline": baseline, "ratio": ratio, "goal": goal}
