"""Streams and batches for benchmarks of ECHO: the shared checkpoint, and walks with boxes."""

import numpy as np

from benchmarks.speed.figures import rate
from benchmarks.speed.planted import swinging
from wearcap.body.skeleton import xsens23
from wearcap.cli.conf import compose, load_pipeline
from wearcap.runtime.wearer import Wearer
from wearcap.scene.objects import Environment
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.stream import EchoStream
from wearsim.places.movables import make_movable

FPS = 30.0
LAP_S = 20.0
"""The walk leads there and back, over and over."""
HELD_S = 2.0
"""For as long a box is the active object, and then none for as long."""


def pipeline_of(config_name: str, runtime: str | None = None, guided: bool = True) -> Echo:
    """A pipeline config around the shared checkpoint."""
    config = compose("capture", [f"pipeline={config_name}", "recording=none"]).pipeline
    config.runtime = runtime or config.runtime
    config.contacts.guidance = config.contacts.guidance if guided else None
    pipeline = load_pipeline("echo", config, "cpu")
    assert isinstance(pipeline, Echo)
    return pipeline


class Streamed:
    """A session that is fed a walk at 30 Hz, of one who takes up a box and lays it down every few seconds."""

    def __init__(self, pipeline: Echo):
        box = make_movable("box", "box", np.random.default_rng(0)).object
        self.session = EchoStream(pipeline, Wearer(xsens23(), floor_m=0.0), Environment((box,)))
        self.number = 0
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
        self.session.poses()
        self.number += 1

    def fill(self) -> "Streamed":
        """Until the window is full, and what is compiled is."""
        for _ in range(2 * self.session.pipeline.model.net.window):
            self.step()
        return self


def frames_per_second(pipeline: Echo, frames: int, repeats: int) -> float:
    """Of a session whose window is full, everything included; the median of some runs of as many frames."""
    stream = Streamed(pipeline).fill()
    return rate(lambda: [stream.step() for _ in range(frames)], frames, repeats)
