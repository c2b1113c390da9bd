"""Streaming MocapEvery: head poses and watch samples go in as they arrive, final poses come out.

Windows, floor and anchoring are those of `MocapEvery.run`: with equal stride, lookahead and initial floor the motion is
the same. Beyond the lookahead, a stream's latency includes the three future frames of the mean filter, and those of the
refinement.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import ImuStream, Motion
from wearcap.recording.timing import joined
from wearcap.runtime.session import HeadAndWristsStream, Session
from wearcap.runtime.wearer import Wearer
from wearcap.sensors import packets
from wearcap.sensors.packets import Admitted
from wearcap.sensors.samples import HeadSample, WatchSample
from wearcap.sensors.watches import FILTER, MAX_GAP_S, filtered
from wearcap.systems.mocap_every.features import Sensed
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.systems.mocap_every.windows import EstimatorWindows, FinalPoses
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.head_path import Chunk
from wearcap.tracking.refinement import Measured, Refiner

MAX_POINTS = 1_000_000
"""Capacity of the buffer of points that wait for a head pose; the oldest are dropped."""


class MocapEveryStream(HeadAndWristsStream):
    """A streaming capture of one wearer.

    Frames are processed once both watches have delivered the samples that they need. A watch without samples for longer
    than `watches.MAX_GAP_S` is assumed static (last orientation, no acceleration) and counted in `silent`.
    """

    def __init__(self, pipeline: MocapEvery, wearer: Wearer):
        super().__init__(pipeline, pipeline.model.fps, pipeline.stride)
        self.wearer = wearer
        self._restart()

    def _restart(self, again: bool = False) -> None:
        super()._restart(again)
        self._windows: EstimatorWindows | None = None
        self._begin_s = 0.0
        self._points: list[Tensor] = []
        self._times = torch.zeros(0, dtype=torch.float64)
        self._heads = Rigid(torch.zeros(0, 3, 3), torch.zeros(0, 3))
        """Head poses of frames that were consumed but not returned yet."""
        self._refiner: Refiner | None = None

    def _take(self, admitted: Admitted) -> None:
        super()._take(admitted)
        self._points += [points for _, (_, points) in admitted.packets if points is not None and len(points)]
        if len(self._points) > 1000:
            self._points = [torch.cat(self._points)[-MAX_POINTS:]]

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

    def _final(self, ended: bool) -> Motion | None:
        while (chunk := self._track.next(ended)) is not None:
            self._chunks.append(chunk)
        motions: list[Motion] = []
        end_s = self._chunks[-1].timestamps[-1].item() if ended and self._chunks else math.inf
        while self._chunks and (ended or self._complete(self._chunks[0])):
            motions += self._advance(self._chunks.pop(0), end_s)
        if ended and self._windows is not None:
            motions += self._end(self._windows)
            self._windows = None
        return joined(motions)

    def _complete(self, chunk: Chunk) -> bool:
        """Whether both watches have delivered all samples that a chunk needs, or are silent."""
        last = chunk.timestamps[-1].item()
        needed = last + (FILTER // 2 + 0.5) / self.pipeline.model.fps
        return self._wrists.arrived(needed, last, self._track.newest, MAX_GAP_S)

    @torch.inference_mode()
    def _advance(self, chunk: Chunk, end_s: float) -> list[Motion]:
        """Run the windows over one chunk of frames; `end_s`: time of the last frame (s), once known."""
        motions: list[Motion] = []
        mount = Rigid(self.wearer.R_head_device, self.wearer.t_head_device).inverse()
        T_world_head = chunk.T_world_device @ mount
        if chunk.begins or self._windows is None:
            if self._windows is not None:
                motions += self._end(self._windows)
            self._begin_s = chunk.timestamps[0].item()
            floor_m = self.wearer.floor_m if self._windows is None else self._windows.floor_m
            if floor_m is None:
                floor_m = T_world_head.t[0, 2].item() - self.pipeline.carried * self.wearer.skeleton.height_of("head")
            follower = self.pipeline.follower(self.wearer.skeleton, floor_m)
            self._windows = EstimatorWindows(self.pipeline, self.wearer.skeleton, follower)
        elif len(chunk.corrected.t):
            self._windows.correct(chunk.corrected @ mount)
        for points in self._points:
            self._windows.floor.see(points)
        self._points.clear()
        R, acc = self._watches(chunk, end_s)
        sensed = Sensed(T_world_head.R, T_world_head.t, R, acc, torch.zeros_like(acc))
        self._times = torch.cat([self._times, chunk.timestamps])
        R_heads, t_heads = torch.cat([self._heads.R, T_world_head.R]), torch.cat([self._heads.t, T_world_head.t])
        self._heads = Rigid(R_heads, t_heads)
        return motions + self._to_motion(self._windows.advance(sensed))

    def _watches(
        self, chunk: Chunk, end_s: float
    ) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"]]:
        """Wrist orientations and filtered accelerations of a chunk; the filter ignores times outside the stretch."""
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
            streams.append(
                ImuStream(
                    torch.tensor([s.timestamp for s in samples], dtype=torch.float64),
                    joint,
                    torch.stack([s.R_world_imu for s in samples]),
                    torch.stack([s.acc_world for s in samples]),
                    R_joint_imu=self.wearer.R_wrist_imu.get(joint),
                )
            )
            oldest_s = around[-FILTER].item() - 2 * step
            kept = self._wrists.samples[joint]
            self._wrists.samples[joint] = [s for s in kept if s.timestamp >= oldest_s] or kept[-1:]
        return filtered(streams, chunk.timestamps, around, step)

    def _to_motion(self, output: FinalPoses) -> list[Motion]:
        """Final frames as a motion with their times, anchored to the head; an empty list for no frames."""
        count = len(output.t_world_root)
        if not count:
            return []
        times, heads = self._times[:count], self._heads[:count]
        self._times, self._heads = self._times[count:], self._heads[count:]
        poses = times, self.wearer.skeleton, output.R_parent_joint, output.t_world_root
        contact_prob = output.contact_prob.repeat_interleave(2, -1)
        pipeline = self.pipeline
        motion = Motion(*poses, contact_prob, provenance=pipeline.settings())
        motion = anchored_to_head(motion, heads) if pipeline.anchor else motion
        if pipeline.refinement is None:
            return [motion]
        if self._refiner is None:
            self._refiner = Refiner(pipeline.refinement, motion.skeleton, pipeline.model.fps, pipeline.anchor)
        return self._refiner.push(motion, Measured.of(heads, output.floor_height))

    def _end(self, windows: EstimatorWindows) -> list[Motion]:
        """The remaining frames of a stretch that has ended."""
        motions = self._to_motion(windows.finish())
        if self._refiner is not None:
            motions += self._refiner.finish()
        self._refiner = None
        return motions


class MocapEverySession(Session):
    """A streaming capture of one or several wearers, each by a `MocapEveryStream`."""

    devices = ("head", *WRISTS)
    given_floor = True

    def __init__(self, pipeline: MocapEvery, wearers: Sequence[Wearer]):
        """Raises WearcapError without wearers."""
        super().__init__(pipeline, [MocapEveryStream(pipeline, wearer) for wearer in wearers])


SESSION = MocapEverySession
