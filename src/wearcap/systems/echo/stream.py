"""Streaming ECHO: tracked points go in as they arrive, bodies and objects come out frame by frame.

The outputs equal those of `Echo` on the whole recording with the same seed, up to inputs that arrive too late; the
latency of a pose is `Echo.latency_s`. Memory use is bounded.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import torch
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion
from wearcap.recording.active_objects import SAME_S, changes
from wearcap.recording.timing import joined
from wearcap.runtime.graphs import undisturbed
from wearcap.runtime.session import HeadAndWristsStream, Session
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.scene.objects import Environment
from wearcap.sensors import packets
from wearcap.sensors.packets import MAX_WAITING
from wearcap.sensors.samples import ActiveObject, HeadSample, ObjectSample, WristSample
from wearcap.systems.echo.contacts import StaticObjects
from wearcap.systems.echo.features import CONTACTS
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.observations import MAX_GAP_S, BatchItem, ObjectShape, wrist_poses
from wearcap.systems.echo.pipeline import Echo, measured_of, motion_of, pulled_by, stretch_seed
from wearcap.systems.echo.queue import Conditioning, EchoQueue, Outputs
from wearcap.tracking.floor import CARRIED, FloorTracker
from wearcap.tracking.head_path import Chunk, HeadPath
from wearcap.tracking.refinement import Refiner

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
        super().__init__(pipeline, pipeline.fps, 1)
        self.wearer, self.seed = wearer, seed
        self._environment, self._reader = environment, pipeline.reader()
        self._shapes: dict[str, ObjectShape] = {}
        """Objects that were named so far, in order of their first use."""
        self._queue: EchoQueue | None = None
        self._activated: list[tuple[float, str | None]] = []
        self._seen: list[tuple[float, str, Rigid]] = []
        self._restart()

    def _guide(self) -> None:
        """Give the queue the bodies and objects that guidance needs, if any."""
        if self._queue is not None and self.pipeline.contact_use.guidance is not None:
            shape, objects = dict(self.wearer.shape), list(self._shapes.values())
            self._queue.guide(pulled_by([self.wearer.skeleton], [shape], [objects]))

    def _restart(self, again: bool = False) -> None:
        if again:
            active = next((name for start, name in reversed(self._activated) if start <= self._track.newest), None)
            self._activated = [] if active is None else [(-math.inf, active)]
            self._seen = []
        super()._restart(again)
        self._queue = None
        self._refiner: Refiner | None = None
        self._pending: list[tuple[float, Conditioning, Rigid]] = []
        """Time, conditioning and head pose of frames that were consumed but not output yet."""
        self._floor = FloorTracker(CARRIED * self.wearer.skeleton.height_of("head"), self.pipeline.fps)
        threshold = self.pipeline.contact_use.static_threshold
        self._static = None if threshold is None else StaticObjects(threshold)

    def wrist(self, joint: str, timestamp: float, T_world_joint: Rigid) -> None:
        """Add a pose of a wrist joint; duplicates are ignored.

        Raises WearcapError for any other joint.
        """
        if joint not in WRISTS:
            raise WearcapError(f"no tracked joint {joint!r}", expected=" or ".join(WRISTS))
        if fault := packets.time_fault(timestamp) or packets.pose_fault(T_world_joint):
            self._head_input.refuse(joint, fault)
            return
        self._wrists.add(joint, (float(timestamp), packets.owned(T_world_joint.R), packets.owned(T_world_joint.t)))

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
        if name is not None:
            used_before = name in self._shapes
            self._shape(name)
            if self.pipeline.placed and not used_before and self._environment is not None:
                # Half a frame later, so that the first frame from `timestamp` on is the nearest one.
                soon = timestamp + 0.499 / self.pipeline.fps
                self._see(name, soon, self._environment.by_name(name).T_world_object)
        self._activated = [span for span in self._activated if span[0] < timestamp] + [(timestamp, name)]
        del self._activated[:-MAX_WAITING]
        self._update_pending()

    def see_object(self, name: str, timestamp: float, T_world_object: Rigid) -> None:
        """Add an observed pose of an object at a time (s), from a camera for instance (ECHO §4.2).

        Raises as `activate` does.
        """
        self._shape(name)
        newest = self._head_input.clock.newest
        if fault := packets.time_fault(timestamp) or packets.pose_fault(T_world_object):
            self._head_input.refuse(name, fault)
        elif math.isfinite(newest) and abs(timestamp - newest) > packets.CONNECTED_S:
            self._head_input.refuse(name, packets.OFF_THE_CLOCK)
        else:
            self._see(name, float(timestamp), packets.owned_pose(T_world_object))

    def _see(self, name: str, timestamp: float, T_world_object: Rigid) -> None:
        self._seen.append((timestamp, name, self._shape(name).centred(T_world_object)))
        del self._seen[:-MAX_SEEN]
        self._update_pending()

    def _shape(self, name: str) -> ObjectShape:
        if name not in self._shapes:
            if self._environment is None:
                raise WearcapError(f"no object {name!r}", expected="a session with an environment")
            item = self._environment.by_name(name)
            item.check(f"object {name!r}")
            self._shapes[name] = self._reader(item)
            self._guide()
        return self._shapes[name]

    def _final(self, ended: bool) -> Motion | None:
        while (chunk := self._track.next(ended)) is not None:
            self._chunks.append(chunk)
        motions: list[Motion] = []
        with undisturbed(self.pipeline.runtime == "onnx"):
            while self._chunks and (ended or self._complete(self._chunks[0])):
                motions += self._advance(self._chunks.pop(0))
            if ended or not (self._chunks or self._track.inside):
                motions += self._finish()
        return joined(motions)

    def _complete(self, chunk: Chunk) -> bool:
        """Whether the poses of both wrists at a frame have arrived, or count as lost."""
        time = chunk.timestamps[-1].item()
        return self._wrists.arrived(time - 1e-6, time, self._track.newest, MAX_GAP_S)

    def _advance(self, chunk: Chunk) -> list[Motion]:
        motions: list[Motion] = []
        if chunk.begins or self._queue is None:
            motions += self._finish()
            seeds, shapes = [stretch_seed(self.seed, chunk.first)], [dict(self.wearer.shape)]
            self._queue = self.pipeline.queue([self.wearer.skeleton], seeds, shapes, [list(self._shapes.values())])
        mount = Rigid(self.wearer.R_head_device, self.wearer.t_head_device).inverse()
        T_world_head = chunk.T_world_device @ mount
        # The head poses of the last frames may have been corrected.
        corrected = chunk.corrected @ mount
        count = min(len(corrected.t), len(self._pending))
        for k in range(-count, 0):
            before_s, conditioning, _ = self._pending[k]
            at = corrected[len(corrected.t) + k : len(corrected.t) + k + 1]
            R, t = conditioning.R_world_point.clone(), conditioning.t_world_point.clone()
            R[0, 0, 0], t[0, 0, 0] = at.R[0], at.t[0]
            self._pending[k] = (before_s, conditioning._replace(R_world_point=R, t_world_point=t), at)
        if count:
            self._update_pending()
        time = chunk.timestamps[0].item()
        conditioning = self._frame(time, T_world_head)
        assert self._queue is not None
        outputs = self._queue.push(conditioning)
        self._pending.append((time, conditioning, T_world_head))
        return motions + self._emit(outputs)

    def _finish(self) -> list[Motion]:
        """The remaining frames of a stretch that has ended."""
        motions: list[Motion] = []
        while self._queue is not None and self._pending:
            motions += self._emit(self._queue.push(self._queue.padding()))
        if self._refiner is not None:
            motions += self._refiner.finish()
        self._queue, self._refiner = None, None
        return motions

    def _frame(self, time: float, T_world_head: Rigid) -> Conditioning:
        poses = [T_world_head]
        for joint in WRISTS:
            seen = self._wrists.samples[joint]
            if not seen or seen[-1][0] < time - MAX_GAP_S:
                self.silent += 1
            if seen:
                times, R, t = zip(*seen)
                track = Trajectory(torch.tensor(times, dtype=torch.float64), torch.stack(R), torch.stack(t))
                pose = wrist_poses(track, torch.tensor([time], dtype=torch.float64))
                poses.append(Rigid(pose.R.float(), pose.t.float()))
                # Only the last second is needed, and one pose before it.
                old = bisect_left(seen, time - 1.0, key=lambda pose: pose[0]) - 1
                self._wrists.samples[joint] = seen[max(old, 0) :]
            else:  # a wrist that was not tracked yet is beside the body, with the arm down
                heading = rotation.about_axis("z", rotation.yaw_of(T_world_head.R))
                aside = ASIDE_M if joint == WRISTS[0] else -ASIDE_M
                below = torch.tensor([0.0, aside, -BELOW * self.wearer.skeleton.height_of("head")])
                poses.append(Rigid(heading, T_world_head.t + (heading @ below[:, None])[..., 0]))
        R, t = torch.stack([T.R for T in poses], 1), torch.stack([T.t for T in poses], 1)
        floor = torch.full((1,), self.wearer.floor_m or 0.0)
        if self.wearer.floor_m is None:
            floor = self._floor.follow(T_world_head.t)
        valid, is_observed = torch.ones(1, dtype=torch.bool), torch.zeros(1, len(MODALITIES), dtype=torch.bool)
        body = torch.eye(3).repeat(1, len(self.wearer.skeleton), 1, 1), torch.zeros(1, 3)
        unobserved = *body, torch.eye(3)[None], torch.zeros(1, 3), torch.zeros(1, CONTACTS)
        fields = R, t, floor, *self._active(time), valid, *unobserved, is_observed
        return self._with_observed_object(Conditioning(*(value[None] for value in fields)), time)

    def _active(self, time: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Whether an object is active at a time, its codes and its index."""
        name = next((name for start, name in reversed(self._activated) if start <= time + SAME_S), None)
        if name is None:
            nothing = self._reader.nothing[None]
            return torch.zeros(1, dtype=torch.bool), nothing, nothing, torch.full((1,), -1.0)
        number, shape = torch.full((1,), float(list(self._shapes).index(name))), self._shapes[name]
        return torch.ones(1, dtype=torch.bool), shape.code[None], shape.code_mirrored[None], number

    def _with_observed_object(self, conditioning: Conditioning, time: float) -> Conditioning:
        """The conditioning with the active object's observation nearest in time, if one is within half a frame."""
        if not conditioning.has_object.item():
            return conditioning
        active, near = list(self._shapes)[int(conditioning.object_number)], 0.5 / self.pipeline.fps + 1e-6
        seen = [(abs(at - time), T) for at, name, T in self._seen if name == active and abs(at - time) <= near]
        if not seen:
            return conditioning
        _, T = min(seen, key=lambda pair: pair[0])
        is_observed = conditioning.is_observed.clone()
        is_observed[..., 1] = True
        return conditioning._replace(
            R_world_object=T.R[None, None], t_world_object=T.t[None, None], is_observed=is_observed
        )

    def _update_pending(self) -> None:
        """Update the conditioning of the queue's frames with inputs that arrived after them."""
        if self._queue is None or self._queue.conditioning is None or not self._pending:
            return
        whole, first = self._queue.conditioning, self._queue.conditioning.valid.shape[1] - len(self._pending)
        frames = [whole.frames(slice(k, k + 1)) for k in range(max(first, 0))]
        for k, (time, conditioning, head) in enumerate(self._pending):
            names = "has_object", "object_code", "object_code_mirrored", "object_number"
            active = {name: value[None] for name, value in zip(names, self._active(time), strict=True)}
            changed = conditioning._replace(**active, is_observed=torch.zeros_like(conditioning.is_observed))
            changed = self._with_observed_object(changed, time)
            self._pending[k] = (time, changed, head)
            frames.append(changed)
        self._queue.conditioning = Conditioning(*(torch.cat(fields, 1) for fields in zip(*frames)))

    def _emit(self, outputs: Outputs | None) -> list[Motion]:
        """The motion of frames that became final; those of padding are left out."""
        if outputs is None:
            return []
        count, first = min(outputs.t_world_root.shape[1], len(self._pending)), 0
        leaving, self._pending = self._pending[:count], self._pending[count:]
        motions: list[Motion] = []
        for _, alike in groupby(leaving, key=lambda frame: frame[1].object_number.item()):
            frames = list(alike)
            part, first = slice(first, first + len(frames)), first + len(frames)
            motions += self._emit_frames(frames, Outputs(*(field[:, part] for field in outputs)))
        return motions

    def _emit_frames(self, frames: Sequence[tuple[float, Conditioning, Rigid]], outputs: Outputs) -> list[Motion]:
        """The same for successive frames with one active object, or none."""
        times, every, heads = zip(*frames)
        conditioning = Conditioning(*(torch.cat(fields, 1) for fields in zip(*every)))
        T_world_head = Rigid(torch.cat([head.R for head in heads]), torch.cat([head.t for head in heads]))
        clock, stretches = torch.tensor(times, dtype=torch.float64), ((0, len(times)),)
        skeleton, floor_height = self.wearer.skeleton, conditioning.floor_height[0]
        path = HeadPath(clock, T_world_head, T_world_head, floor_height, skeleton, stretches)
        # Object events that no later frame needs are dropped.
        self._seen = [row for row in self._seen if row[0] > times[-1] - 1.0]
        past = [k for k, (start, _) in enumerate(self._activated) if start <= times[-1]]
        self._activated = self._activated[past[-1] :] if past else self._activated
        if self._static is not None:
            one = (Outputs(*(field[:, k : k + 1] for field in outputs)) for k in range(len(times)))
            static = [self._static(each, part) for each, part in zip(every, one)]
            outputs = Outputs(*(torch.cat(fields, 1) for fields in zip(*static)))
        pipeline, item = self.pipeline, BatchItem(path, conditioning, list(self._shapes.values()))
        motion = motion_of(item, outputs, pipeline.anchor, pipeline.settings(), pipeline.model.contacts)
        if pipeline.refinement is None:
            return [motion]
        if self._refiner is None:
            self._refiner = Refiner(pipeline.refinement, motion.skeleton, pipeline.fps, pipeline.anchor)
        return self._refiner.push(motion, measured_of(item))


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
