"""A capture that only seems to run: persons who walk, their devices, and a record of what its page asks."""

import threading
import time
from dataclasses import replace

import torch

from walking_person import SEAT, room, walk
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.status import Ask, Counts, DeviceStatus, Latency, LiveStatus, SinkStatus, WearerStatus
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion

FPS, PIECE = 60.0, 10


def walking(seconds: float, aside_m: float = 0.0) -> Motion:
    """Someone who walks round a circle, `aside_m` (m) away from where the others do."""
    motion, contact = walk(torch.arange(int(seconds * FPS), dtype=torch.float64) / FPS)
    moved = motion.t_world_root + torch.tensor([aside_m, 0.0, 0.0])
    return replace(motion, t_world_root=moved, contact_prob=contact.float())


class Show:
    """Controls of a capture with these persons; `play` gives a sink their motion as it happens."""

    def __init__(self, persons: dict[str, Motion], stage: str = "live"):
        self.persons, self.stage, self.asked = persons, stage, []
        self.recording, self.step, self.progress = None, None, 0.0
        self.notes = ("Height: 1.75 m, from the head 1.58 m above the floor.",)
        self.points = room().points_world
        self.begun_s = time.monotonic()
        self.stopped = threading.Event()
        self._frame = 0

    def status(self) -> LiveStatus:
        wearers = tuple(self._wearer(name, motion) for name, motion in self.persons.items())
        sinks = (SinkStatus("vmc 127.0.0.1:39539", 1200, 3), SinkStatus("bvh", 900, 0, 2, "the disk is full"))
        return LiveStatus(wearers, sinks, self.recording, time.monotonic() - self.begun_s)

    def _wearer(self, name: str, motion: Motion) -> WearerStatus:
        frame = min(self._frame, len(motion) - 1)
        head, wrists = motion.joint("head")[frame] @ SEAT, [motion.joint(f"{side}_wrist") for side in ("left", "right")]
        nowhere = torch.full((3,), torch.nan)
        devices = (
            DeviceStatus("head", 72.0, head, 0.01),
            DeviceStatus("watch-7", 99.6, Rigid(wrists[0][frame].R, nowhere), 0.01, "left_wrist"),
            DeviceStatus("right_wrist", 0.0, Rigid(wrists[1][frame].R, wrists[1][frame].t), 4.2),
        )
        return WearerStatus(
            name,
            self.stage,  # pyright: ignore[reportArgumentType]
            self.step,
            self.progress,
            devices,
            Latency(41.0, 63.0, 88.0),
            Counts(frames=self._frame, dropped=7, late=11, gaps=2),
            0.0,
            self.points,
            self.notes,
        )

    def record(self, on: bool) -> None:
        self.asked.append(("record", on))
        self.recording = "recordings/walk" if on else None

    def ask(self, action: Ask, wearer: str) -> None:
        self.asked.append((action, wearer))
        if action == "guide":
            self.stage, self.step, self.progress = "first minute", "Stand still and look straight ahead.", 0.4
        elif action == "skip":
            self.step, self.progress = "Let your arms hang. The left watch still moves.", 0.1

    def stop(self) -> None:
        self.asked.append(("stop",))
        self.stopped.set()

    def play(self, sink: Sink, seconds: float = float("inf")) -> threading.Thread:
        """Give the sink pieces of `PIECE` frames, each when its last one has happened."""
        skeletons: dict[str, Skeleton] = {name: motion.skeleton for name, motion in self.persons.items()}
        for name, skeleton in skeletons.items():
            sink.begin(name, skeleton, FPS)

        def run() -> None:
            begin = time.monotonic()
            while not self.stopped.is_set() and (now := time.monotonic() - begin) < seconds:
                until = int(now * FPS)
                while self._frame + PIECE <= min(until, min(len(motion) for motion in self.persons.values())):
                    piece = (self._frame, self._frame + PIECE)
                    for name, motion in self.persons.items():
                        sink.take(name, motion.sliced(*piece))
                    self._frame += PIECE
                time.sleep(0.02)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread
