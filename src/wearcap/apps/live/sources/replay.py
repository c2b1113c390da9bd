"""Replay: a recording's sensors as if they were sent now, at their own pace or as fast as the capture takes them."""

import asyncio
import math
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from wearcap.apps.live.packets import CAMERA, HANDS, HEAD, OBJECT, SUIT, Inbox, Packet
from wearcap.apps.live.setup import Seat, Setup
from wearcap.apps.live.source import Address, Source
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import ImuStream, Motion, Recording
from wearcap.recording.active_objects import SAME_S
from wearcap.recording.recording import FingerStream
from wearcap.runtime.session import Session
from wearcap.sensors.imu import acceleration
from wearcap.sensors.samples import (
    ActiveObject,
    HandSample,
    HeadSample,
    LocalizationSample,
    ObjectSample,
    SuitPiece,
    WatchSample,
    WristSample,
)
from wearcap.tracking.stature import skeleton_of

AHEAD = 256
"""Packets that may wait for the capture in a replay as fast as it goes."""
MAX_NEW_POINTS = 20_000
"""Points of the surroundings that are sent with one head pose; more wait for the next ones."""


class ReplaySource(Source):
    """Sends what a recording sensed; watches and wrists that it lacks are made of its true motion."""

    scheme, port, hz = "replay", 0, 60.0
    convention = "the recording's own"
    lossless = True
    """What comes out must be the capture of the whole recording."""

    def __init__(
        self,
        recording: Recording,
        kind: type[Session],
        speed: float = 1.0,
        wearer: str = "",
        objects: Sequence[ActiveObject | ObjectSample] = (),
    ):
        """`kind`: class of the session, which says what it needs; `speed` times real time, inf: as fast as it goes;
        `objects`: samples of objects in order of time, as `Session.of_objects` has them.

        Raises WearcapError for a recording that has not all of these devices, and for a speed that is not positive.
        """
        super().__init__(Address("replay", "127.0.0.1", 0))
        if not speed > 0:
            raise WearcapError(f"speed={speed}", expected="a positive number, or inf: as fast as it goes")
        self.recording, self.kind, self.speed, self.wearer = recording, kind, speed, wearer
        self.objects = list(objects)
        optional = [device for device in kind.optional if device in recording.tracked]
        self.streams = {device: self._stream(device, kind.tracks_wrists) for device in (*kind.devices, *optional)}
        self.streams |= {hand: recording.fingers[side] for hand, side in HANDS.items() if side in recording.fingers}

    @property
    def name(self) -> str:
        return f"replay:{self.recording.name}"

    @property
    def url(self) -> str:
        return f"a replay of {self.recording.name}"

    @property
    def setup(self) -> Setup | None:
        """What the recording says of its wearer; None where it does not know the body."""
        recording, skeleton = self.recording, skeleton_of(self.recording)
        if skeleton is None:
            return None
        seats = {joint: Seat(joint, torch.eye(3), torch.zeros(3)) for joint in WRISTS}
        for joint, stream in recording.imu.items():
            if joint in seats and stream.R_joint_imu is not None:
                seats[joint] = Seat(joint, stream.R_joint_imu, torch.zeros(3))
        if recording.head is not None:
            seats[HEAD] = Seat(HEAD, recording.head.R_head_device, recording.head.t_head_device)
        floor = recording.floor
        floor_m = None
        if self.kind.given_floor and floor is not None and len(floor.height):
            floor_m = floor.height[0].item()
        return Setup(skeleton, seats, floor_m, ("As the recording has it.",))

    async def run(self, inbox: Inbox) -> None:
        begin_s, first_s = time.monotonic(), None
        for sent_s, device, sample in self.events():
            first_s = sent_s if first_s is None else first_s
            if math.isinf(self.speed):
                while inbox.waiting > AHEAD:
                    await asyncio.sleep(0.001)
            else:
                due_s = begin_s + (sent_s - first_s) / self.speed
                if (left_s := due_s - time.monotonic()) > 0:
                    await asyncio.sleep(left_s)
            inbox.deliver([Packet(self.wearer, device, self.name, sent_s, time.monotonic(), sample)])

    def events(self) -> Iterator[tuple[float, str, object]]:
        """(time, device, sample) of all devices in order of time."""
        times = {device: _times(stream) for device, stream in self.streams.items()}
        every = torch.cat(list(times.values()))
        owner = torch.cat([torch.full((len(part),), k) for k, part in enumerate(times.values())])
        row = torch.cat([torch.arange(len(part)) for part in times.values()])
        names, points = list(times), self._points(times[HEAD]) if HEAD in times else []
        # Of samples at one time the head's comes last: a frame may then be final at once.
        last = owner == names.index(HEAD) if HEAD in names else torch.zeros(len(owner), dtype=torch.bool)
        order = sorted(range(len(every)), key=lambda k: (every[k].item(), last[k].item()))
        waiting = self._objects(every.min().item())
        for k in order:
            while waiting and waiting[0].timestamp <= every[k].item() + SAME_S:
                sample = waiting.pop(0)
                device = OBJECT if isinstance(sample, ActiveObject) else f"{OBJECT} {sample.name}"
                yield sample.timestamp, device, sample
            device, index = names[int(owner[k])], int(row[k])
            yield every[k].item(), device, self._sample(device, index, points)

    def _objects(self, first_s: float) -> list[ActiveObject | ObjectSample]:
        """The samples of objects; the object that is active at the first time (s) of all devices is named then."""
        choices = [sample for sample in self.objects if isinstance(sample, ActiveObject)]
        active = next((sample for sample in reversed(choices) if sample.timestamp <= first_s + SAME_S), None)
        first = [] if active is None else [active._replace(timestamp=first_s)]
        return first + [sample for sample in self.objects if sample.timestamp > first_s + SAME_S]

    def _sample(self, device: str, k: int, points: list[Tensor | None]) -> object:
        stream = self.streams[device]
        match stream:
            case ImuStream():
                assert stream.R_world_imu is not None
                assert stream.acc_world is not None
                return WatchSample(stream.timestamps[k].item(), stream.R_world_imu[k], stream.acc_world[k], device)
            case Trajectory():
                return WristSample(device, stream.timestamps[k].item(), stream.T_world_body[k])
            case FingerStream():
                return HandSample(HANDS[device], stream.timestamps[k].item(), stream.frame(k))
            case Motion():
                return SuitPiece(stream.sliced(k, k + 1))
        time_s = stream.timestamps[k].item()
        if device == CAMERA:
            pose = Rigid(stream.R_world_cam[k], stream.t_world_cam[k])
            return LocalizationSample(time_s, pose, stream.confidence[k].item())
        return HeadSample(time_s, stream.T_world_device[k], points[k], self._embedding(time_s))

    def _embedding(self, time_s: float) -> Tensor | None:
        camera = self.recording.camera
        if camera is None or camera.embedding is None:
            return None
        k = int(torch.searchsorted(camera.timestamps, time_s - 1e-6))
        found = k < len(camera.timestamps) and abs(camera.timestamps[k].item() - time_s) < 1e-6
        return camera.embedding[k] if found else None

    def _points(self, heads: Tensor) -> list[Tensor | None]:
        """Points that are new at each head pose; None throughout where there is no cloud."""
        cloud = self.recording.points
        if cloud is None:
            return [None] * len(heads)
        if cloud.first_seen is None:
            parts = cloud.points_world.split(MAX_NEW_POINTS)[: len(heads)]
            return [*parts, *[cloud.points_world[:0]] * (len(heads) - len(parts))]
        first_seen, order = cloud.first_seen.sort()
        edges = torch.searchsorted(first_seen, heads, right=True).tolist()
        return [cloud.points_world[order[a:b]] for a, b in pairwise([0, *edges])]

    def _stream(self, device: str, tracks_wrists: bool):
        """A device's stream. Raises WearcapError where the recording has none."""
        recording, truth = self.recording, self.recording.motion
        found = None
        if device in WRISTS and tracks_wrists:
            found = recording.tracked.get(device)
            if found is None and truth is not None:
                pose = truth.joint(device)
                found = Trajectory(truth.timestamps, pose.R, pose.t)
        elif device in WRISTS:
            found = recording.imu.get(device)
            if found is None and truth is not None:
                pose, fps = truth.joint(device), truth.fps
                acc = acceleration(pose.t, fps, max(1, round(4 * fps / 30)))
                found = ImuStream(truth.timestamps, device, pose.R, acc)
            if found is not None and (found.R_world_imu is None or found.acc_world is None):
                found = None
        else:
            found = {HEAD: recording.head, SUIT: recording.suit, CAMERA: recording.localization}[device]
        if found is None or not len(_times(found)):
            expected = f"{', '.join(self.kind.devices)}, as this system needs"
            raise WearcapError(f"a recording without {device.replace('_', ' ')}", recording.name, expected)
        return found


def _times(stream) -> Tensor:
    return stream.timestamps
