"""Streaming ECHO: tracked points go in as they arrive, bodies and objects come out frame by frame.

The outputs equal those of `Echo` on the whole recording with the same seed, up to inputs that arrive too late; the
latency of a pose is `Echo.latency_s`. Memory use is bounded.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording.active_objects import changes
from wearcap.runtime.graphs import undisturbed
from wearcap.runtime.session import HeadAndWristsStream, Session
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.runtime.windows import appended, cut
from wearcap.scene.objects import Environment
from wearcap.sensors import packets
from wearcap.sensors.packets import MAX_WAITING, Admitted
from wearcap.sensors.samples import ActiveObject, HeadSample, ObjectSample, WristSample
from wearcap.systems.echo.contacts import StaticObjects
from wearcap.systems.echo.objects import ActiveObjects
from wearcap.systems.echo.observations import MAX_GAP_S, BatchItem, wrist_poses
from wearcap.systems.echo.pipeline import Echo, measured_of, motion_of, pulled_by, stretch_seed
from wearcap.systems.echo.queue import Conditioning, EchoQueue, Outputs
from wearcap.tracking.floor import CARRIED, FloorTracker
from wearcap.tracking.head_path import Chunk, HeadPath
from wearcap.tracking.wrists import seen_wrist

MAX_SEEN = 1000
"""Most object observations that are buffered; the oldest are dropped."""
ASIDE_M, BELOW = 0.25, 0.47
"""Position of a wrist with the arm down: beside the head (m), and below it as a share of the head's height."""


class EchoStream(HeadAndWristsStream):
    """A streaming capture of one wearer and some objects; the active object is kept when the clock is set back."""

    def __init__(self, pipeline: Echo, wearer: Wearer, environment: Environment | None = None, seed: int = 0):
        """Raises WearcapError for a pipeline whose windows inpaint their overlap."""
        how = pipeline.sampling
        if how.rewindow is not None and not how.average:
            what = f"a stream with rewindow={how.rewindow}"
            raise WearcapError(what, expected="average=true, or a conveyor: rewindow=null, rewindow_steps=null")
        super().__init__(pipeline, wearer, stride=1, needs_s=-1e-6)
        self.seed = seed
        self._objects = ActiveObjects(pipeline.reader(), environment, pipeline.placed)
        self._begin()

    def _begin(self) -> None:
        super()._begin()
        self._floor = FloorTracker(CARRIED * self.wearer.skeleton.height_of("head"), self.pipeline.fps)
        threshold = self.pipeline.contact_use.static_threshold
        self._static = None if threshold is None else StaticObjects(threshold)

    def _restart(self, admitted: Admitted) -> None:
        if admitted.again:
            active = self._objects.active(self._track.newest)
            self._objects.changes = [] if active is None else [(-math.inf, active)]
            self._objects.seen = []
        super()._restart(admitted)

    def wrist(self, joint: str, timestamp: float, T_world_joint: Rigid) -> None:
        """Add a pose of a wrist joint; duplicates are ignored.

        Raises WearcapError for any other joint.
        """
        if joint not in WRISTS:
            raise WearcapError(f"no tracked joint {joint!r}", expected=" or ".join(WRISTS))
        self._wrists.add_pose(joint, timestamp, T_world_joint)

    def take(self, sample: Any) -> None:
        """Take in one sample of the head device, a wrist or an object, or the choice of the active object."""
        match sample:
            case HeadSample():
                self.head(sample.timestamp, sample.T_world_device)
            case WristSample() if sample.joint in WRISTS:
                self.wrist(*sample)
            case ActiveObject():
                self.activate(*sample)
            case ObjectSample():
                self.see_object(*sample)
            case _:
                self._head_input.refuse("sample", packets.WRONG_TYPE)

    def activate(self, name: str | None, timestamp: float) -> None:
        """Make an object the active one from `timestamp` (s) on; None: no object is active.

        Frames that are not final yet are updated. Raises WearcapError for an unknown object, and for one whose mesh or
        class cannot be used.
        """
        if fault := packets.time_fault(timestamp):
            self._head_input.refuse("activate", fault)
            return
        self._objects.activate(name, timestamp)
        del self._objects.changes[:-MAX_WAITING]
        self._update()

    def see_object(self, name: str, timestamp: float, T_world_object: Rigid) -> None:
        """Add an observed pose of an object at a time (s), from a camera for instance (ECHO §4.2).

        Raises as `activate` does.
        """
        self._objects.shape(name)
        newest = self._head_input.clock.newest
        if fault := packets.time_fault(timestamp) or packets.pose_fault(T_world_object):
            self._head_input.refuse(name, fault)
        elif math.isfinite(newest) and abs(timestamp - newest) > packets.CONNECTED_S:
            self._head_input.refuse(name, packets.OFF_THE_CLOCK)
        else:
            self._objects.see(name, float(timestamp), packets.owned_pose(T_world_object))
        del self._objects.seen[:-MAX_SEEN]
        self._update()

    def _update(self) -> None:
        """Update the queue's frames that are not final with what is known of objects now."""
        if (queue := self.windows) is None or queue.frames is None:
            return
        if queue.guided is not None and len(queue.guided[1][0]) < len(self._objects.shapes):
            queue.guide(pulled_by([self.wearer.skeleton], [dict(self.wearer.shape)], [self._objects.shapes]))
        if count := queue.pending:
            fresh = self._objects.updated(queue.frames.frames(slice(-count, None)))
            queue.frames = appended(queue.frames.frames(slice(-count)), fresh)

    def _advance(self, ended: bool) -> None:
        with undisturbed(self.pipeline.runtime == "onnx"):
            super()._advance(ended)

    def _opened(self, chunk: Chunk) -> EchoQueue:
        seeds, shapes = [stretch_seed(self.seed, chunk.first)], [dict(self.wearer.shape)]
        return self.pipeline.queue([self.wearer.skeleton], seeds, shapes, [self._objects.shapes])

    def _sensed(self, chunk: Chunk, ended: bool) -> tuple[Conditioning]:
        if len(chunk.corrected.t):
            self._update()
        return (self._frame(chunk.timestamps, self._head_of(chunk.T_world_device)),)

    def _frame(self, timestamps: Float64[Tensor, "1"], T_world_head: Rigid) -> Conditioning:
        poses, time = [T_world_head], timestamps.item()
        there, gaps = torch.ones(1, 3, dtype=torch.bool), self.pipeline.model.features.gaps
        for number, joint in enumerate(WRISTS, 1):
            track = self._wrists.track(joint, time)
            if track is None or track.timestamps[-1] < time - MAX_GAP_S:
                self.silent += 1
            if track is not None:
                pose = wrist_poses(track, timestamps)
                there[:, number] = seen_wrist(track, timestamps)[1] if gaps else True
                poses.append(Rigid(pose.R.float(), pose.t.float()))
            else:  # a wrist that was not tracked yet is beside the body, with the arm down
                heading = rotation.about_axis("z", rotation.yaw_of(T_world_head.R))
                aside = ASIDE_M if joint == WRISTS[0] else -ASIDE_M
                below = torch.tensor([0.0, aside, -BELOW * self.wearer.skeleton.height_of("head")])
                poses.append(Rigid(heading, T_world_head.t + (heading @ below[:, None])[..., 0]))
                there[:, number] = not gaps
        R, t = torch.stack([T.R for T in poses], 1), torch.stack([T.t for T in poses], 1)
        floor = torch.full((1,), self.wearer.floor_m or 0.0)
        if self.wearer.floor_m is None:
            floor = self._floor.follow(T_world_head.t)
        return self._objects.frames(timestamps, R, t, floor, len(self.wearer.skeleton), there)

    def _take(self, ended: bool) -> None:
        if (found := self.windows.take(ended)) is None:
            return
        frames, outputs = found
        # One piece for each active object, or none
        _, lengths = frames.object_number[0].unique_consecutive(return_counts=True)
        stop = 0
        for length in lengths.tolist():
            part, stop = slice(stop, stop + length), stop + length
            self._take_piece(frames.frames(part), cut(outputs, part))

    def _take_piece(self, frames: Conditioning, outputs: Outputs) -> None:
        """The same for successive frames with one active object, or none."""
        times, T_world_head, count = frames.timestamps[0], frames.T_world_head[0], frames.valid.shape[1]
        floor_height, stretches = frames.floor_height[0], ((0, count),)
        path = HeadPath(times, T_world_head, T_world_head, floor_height, self.wearer.skeleton, stretches)
        self._objects.forget(times[-1].item())
        if self._static is not None:
            each = [slice(k, k + 1) for k in range(count)]
            static = [self._static(frames.frames(one), cut(outputs, one)) for one in each]
            outputs = Outputs(*(torch.cat(fields, 1) for fields in zip(*static)))
        pipeline, item = self.pipeline, BatchItem(path, frames, self._objects.shapes)
        motion = motion_of(item, outputs, pipeline.anchor, pipeline.settings(), pipeline.model.contacts)
        self._refine(motion, measured_of(item))


class EchoSession(Session):
    """A streaming capture of one or several wearers and the objects of one environment, each by an `EchoStream`."""

    devices = ("head", *WRISTS)
    given_floor = True
    takes_objects = True
    tracks_wrists = True

    def __init__(
        self,
        pipeline: Echo,
        wearers: Sequence[Wearer],
        seeds: Sequence[int] | None = None,
        environment: Environment | None = None,
    ):
        """Raises WearcapError without wearers, and for a pipeline whose windows inpaint their overlap."""
        seeds = [0] * len(wearers) if seeds is None else seeds
        pairs = zip(wearers, seeds, strict=True)
        super().__init__(pipeline, [EchoStream(pipeline, wearer, environment, seed) for wearer, seed in pairs])

    @classmethod
    def of_wearers(
        cls, system: Echo, wearers: Sequence[Wearer], seed: int = 0, source: CaptureInput | None = None
    ) -> "EchoSession":
        environment = None if source is None else system.objects(source)
        return cls(system, wearers, range(seed, seed + len(wearers)), environment)

    @classmethod
    def of_objects(cls, system: Echo, source: CaptureInput) -> list[ActiveObject | ObjectSample]:
        scenario = system.scenario(source.recording, system.objects(source))
        return [ActiveObject(name, time_s) for time_s, name in changes(scenario.active_objects)]


SESSION = EchoSession
