"""Streaming MocapEvery: head poses and watch samples go in as they arrive, final poses come out.

Windows, floor and anchoring are those of `MocapEvery.run`: with equal stride, lookahead and initial floor the motion is
the same. Beyond the lookahead, a stream's latency includes the three future frames of the mean filter, and those of the
refinement.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.recording import ImuStream
from wearcap.runtime.session import HeadAndWristsStream, Session
from wearcap.runtime.wearer import Wearer
from wearcap.sensors import packets
from wearcap.sensors.samples import HeadSample, WatchSample
from wearcap.sensors.watches import FILTER, MAX_GAP_S, filtered
from wearcap.systems.mocap_every.features import Sensed
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.systems.mocap_every.windows import EstimatorWindows
from wearcap.tracking.head_path import Chunk

MAX_POINTS = 1_000_000
"""Capacity of the buffer of points that wait for a head pose; the oldest are dropped."""


class MocapEveryStream(HeadAndWristsStream):
    """A streaming capture of one wearer.

    Frames are processed once both watches have delivered the samples that they need. A watch without samples for longer
    than `watches.MAX_GAP_S` is assumed static (last orientation, no acceleration) and counted in `silent`.
    """

    def __init__(self, pipeline: MocapEvery, wearer: Wearer):
        super().__init__(pipeline, wearer, pipeline.overlap.stride, needs_s=(FILTER // 2 + 0.5) / pipeline.fps)
        self._begin()

    def _begin(self) -> None:
        super()._begin()
        self._begin_s = 0.0
        self._points: list[tuple[Tensor, Tensor]] = []
        """Points (m) that no windows have yet, and the times (s) they were first seen."""

    def _accept(self, sample: HeadSample) -> None:
        super()._accept(sample)
        if (points := sample.points_world) is not None and len(points):
            self._points.append((points, torch.full((len(points),), sample.timestamp, dtype=torch.float64)))
        if len(self._points) > 1000:
            points, seen = (torch.cat(part)[-MAX_POINTS:] for part in zip(*self._points))
            self._points = [(points, seen)]

    def take(self, sample: Any) -> None:
        """Take in one sample of the head camera or of a watch."""
        match sample:
            case HeadSample():
                self.head(sample.timestamp, sample.T_world_device, sample.points_world)
            case WatchSample() if sample.joint in WRISTS:
                self.watch(sample.joint, [sample])
            case _:
                self._head_input.refuse("sample", packets.WRONG_TYPE)

    def watch(self, joint: str, samples: Sequence[WatchSample]) -> None:
        """Take in samples of a watch; repeated samples are ignored.

        Raises WearcapError for joints other than the wrists.
        """
        if joint not in WRISTS:
            raise WearcapError(f"no watch on {joint!r}", expected=" or ".join(WRISTS))
        for sample in samples:
            fault = packets.WRONG_TYPE
            if isinstance(sample, WatchSample):
                fault = packets.time_fault(sample.timestamp) or packets.rotation_fault(sample.R_world_imu)
                fault = fault or packets.values_fault(sample.acc_world, (3,), packets.MAX_ACC_M_S2)
            if fault:
                self._head_input.refuse(joint, fault)
                continue
            values = packets.owned(sample.R_world_imu), packets.owned(sample.acc_world)
            self._wrists.add(joint, WatchSample(float(sample.timestamp), *values))

    def _opened(self, chunk: Chunk) -> EstimatorWindows:
        self._begin_s, skeleton = chunk.timestamps[0].item(), self.wearer.skeleton
        floor_m = self.wearer.floor_m if self.windows is None else self.windows.floor_m
        if floor_m is None:
            head_m = self._head_of(chunk.T_world_device).t[0, 2].item()
            floor_m = head_m - self.pipeline.carried * skeleton.height_of("head")
        return self.pipeline.windows(skeleton, floor_m)

    def _sensed(self, chunk: Chunk, ended: bool) -> tuple[Float64[Tensor, "time"], Sensed]:
        self.windows.points += self._points
        self._points = []
        T_world_head, last = self._head_of(chunk.T_world_device), (self._chunks or [chunk])[-1]
        R, acc = self._watches(chunk, last.timestamps[-1].item() if ended else math.inf)
        return chunk.timestamps, Sensed(T_world_head.R, T_world_head.t, R, acc, torch.zeros_like(acc))

    def _watches(
        self, chunk: Chunk, end_s: float
    ) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"]]:
        """Wrist orientations and filtered accelerations of a chunk; the filter ignores times outside the stretch, whose end
        (s) is known once no more samples come."""
        step = 1 / self.pipeline.model.fps
        frames = torch.arange(-(FILTER // 2), len(chunk.timestamps) + FILTER // 2, dtype=torch.float64)
        around = (chunk.timestamps[0] + step * frames).clamp(self._begin_s, end_s)
        streams = []
        for joint, samples in self._wrists.samples.items():
            if not samples or samples[-1].timestamp < chunk.timestamps[-1].item() - MAX_GAP_S:
                self.silent += len(chunk.timestamps)
                # A static watch with its last orientation, around the chunk.
                R = samples[-1].R_world_imu if samples else torch.eye(3)
                ends_s = chunk.timestamps[0].item() - 1.0, chunk.timestamps[-1].item() + 1.0
                samples = [WatchSample(time_s, R, torch.zeros(3)) for time_s in ends_s]
            elif len(samples) == 1:
                samples = [samples[0]._replace(timestamp=samples[0].timestamp - step), *samples]
            times, R, acc, _ = zip(*samples)
            times, mount = torch.tensor(times, dtype=torch.float64), self.wearer.R_wrist_imu.get(joint)
            streams.append(ImuStream(times, joint, torch.stack(R), torch.stack(acc), R_joint_imu=mount))
            oldest_s = around[-FILTER].item() - 2 * step
            kept = self._wrists.samples[joint]
            self._wrists.samples[joint] = [s for s in kept if s.timestamp >= oldest_s] or kept[-1:]
        return filtered(streams, chunk.timestamps, around, step)


class MocapEverySession(Session):
    """A streaming capture of one or several wearers, each by a `MocapEveryStream`."""

    devices = ("head", *WRISTS)
    given_floor = True

    def __init__(self, pipeline: MocapEvery, wearers: Sequence[Wearer]):
        """Raises WearcapError without wearers."""
        super().__init__(pipeline, [MocapEveryStream(pipeline, wearer) for wearer in wearers])


SESSION = MocapEverySession
