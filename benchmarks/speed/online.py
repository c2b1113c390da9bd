"""Streams for benchmarks of HMD²: a checkpoint or its size with random weights, and moments of a walk among points."""

import statistics
import sys
import time

import torch
from hydra.utils import instantiate

from benchmarks.speed.planted import swinging
from wearcap.body.skeleton import xsens23
from wearcap.cli.conf import compose, load_pipeline
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.geometry.rigid import Rigid
from wearcap.models.checkpoint import shared_checkpoints
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.runtime.wearer import Wearer
from wearcap.systems.hmd2.conditions import Images, Points
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.stream import HeadSample, HMD2Session
from wearcap.systems.hmd2.windows import DiffusionModel

EXPERIMENTS = {"small": "hmd2", "full": "full/hmd2"}
"""Experiments of both sizes; where there is a checkpoint, it has the same name."""
IMAGE = 64
LAP_S = 20.0
"""The walk leads there and back, over and over."""
NEW_POINTS = 40
"""Points that come with each pose."""


def pipeline_of(size: str) -> HMD2:
    """The online pipeline around a checkpoint of the project, or around random weights of that size, which is printed."""
    config = compose("capture", ["pipeline=hmd2_online", "recording=none"]).pipeline
    if EXPERIMENTS[size] in shared_checkpoints():
        pipeline = load_pipeline(EXPERIMENTS[size], config, "cpu")
        assert isinstance(pipeline, HMD2)
    else:
        net = random_net(size)
        conditions = {"points": Points(VoxelAutoencoder()), "image": Images(IMAGE, "any")}
        model = DiffusionModel(net, _FEATURES, CosineSchedule(), xsens23(), 60.0, conditions)
        pipeline = instantiate(config, _convert_="all")(model=model, device="cpu")
        count = sum(parameter.numel() for parameter in net.parameters()) / 1e6
        print(f"no checkpoint {EXPERIMENTS[size]!r}: random weights, {count:.1f} M parameters", file=sys.stderr)
    return pipeline


_FEATURES = HeadFeatures(contacts=True, body=True)


def random_net(size: str) -> MotionDenoiser:
    """The network of an experiment's config, its weights drawn."""
    torch.manual_seed(0)
    config = compose("train", [f"experiment={EXPERIMENTS[size]}"])
    net = instantiate(config.model.net)(
        motion_size=_FEATURES.motion_size,
        condition_size=_FEATURES.condition_size,
        conditions={"points": VoxelAutoencoder().size, "image": IMAGE},
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    return net


class Walk:
    """A head's path there and back at 60 Hz, with an embedding every other frame, and points on the first lap."""

    def __init__(self, pipeline: HMD2):
        self.pipeline = pipeline
        head = swinging("walk", LAP_S / 2, 0).head
        assert head is not None
        there = head.T_world_device
        self.lap = Rigid(torch.cat([there.R, there.R.flip(0)]), torch.cat([there.t, there.t.flip(0)]))
        self._random = torch.Generator().manual_seed(0)

    def moment(self, number: int) -> HeadSample:
        place = number % len(self.lap.t)
        pose = self.lap[place]
        count = NEW_POINTS if number < len(self.lap.t) else 0
        points = pose.t + 4 * torch.rand(count, 3, generator=self._random) - torch.tensor([2.0, 2.0, 3.0])
        shown = (
            torch.randn(self.pipeline.model.net.conditions["image"], generator=self._random)
            if number % 2 == 0
            else None
        )
        return HeadSample(number / 60, pose, points, shown)


class Streamed:
    """A session that is fed a walk; seconds of work per push that gives poses."""

    def __init__(self, pipeline: HMD2):
        self.session, self.walk, self.number = HMD2Session(pipeline, [Wearer(xsens23())], [0]), Walk(pipeline), 0
        self.stride, self.seconds = pipeline.advance, []

    def step(self) -> None:
        """One stride: everything from its first moment to its poses."""
        moments = [self.walk.moment(self.number + i) for i in range(self.stride)]
        self.number += self.stride
        begin = time.perf_counter()
        for moment in moments:
            self.session.push([[moment]])
            self.session.poses()
        self.seconds.append(time.perf_counter() - begin)

    def fill(self) -> "Streamed":
        """Until windows are full, and what is compiled is."""
        while self.number < self.session.system.window + 3 * self.stride:
            self.step()
        self.seconds.clear()
        return self

    @property
    def frames_per_second(self) -> float:
        return self.stride / statistics.median(self.seconds)


def frames_per_second(pipeline: HMD2, pushes: int = 40) -> float:
    """Rate at which a full window advances by the pipeline's stride, everything included."""
    stream = Streamed(pipeline).fill()
    for _ in range(pushes):
        stream.step()
    return stream.frames_per_second
