"""Captured motion in fitting simulated surroundings: the same recordings, with points and a head camera."""

import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.simulated import source_files
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import HeadStream, PointCloud, Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.sensors.slam import semidense_points
from wearcap.simulation.places.surround import surround
from wearcap.simulation.places.world import World
from wearcap.simulation.rendering.ego_view import write_ego_video

TURNS, DOWN_DEG, VIEW_S = 12, (0.0, 38.0), 0.25
"""Steps per turn, pitch of each turn (°), duration of a step (s) of the wearer's turns on the spot before the recording."""


@dataclass(frozen=True)
class Surrounded:
    """One recording and its simulated surroundings; picklable, callable as a task."""

    file: Path
    name: str
    root: Path
    camera: bool
    look_round: bool
    seed: int

    def __call__(self) -> Recording:
        recording = RecordingFile(self.file).load()
        motion, head = recording.motion, recording.head
        if motion is None or head is None:
            raise WearcapError("no motion or no head path", where=self.file, expected="motion capture with both")
        seed = [self.seed, zlib.crc32(self.name.encode())]
        of_world, of_points, of_camera = (np.random.default_rng([number, *seed]) for number in (31, 32, 33))
        world = surround(motion, of_world, f"cmu-room-{self.name}")
        points = seen_points(world, head, self.look_round, of_points)
        recording = replace(recording, points=points, location=world.name)
        if not self.camera:
            return recording
        file = self.root / "videos" / f"{self.name}.mp4"
        camera = write_ego_video(file, world, motion, recording.shape, head.t_head_device, of_camera)
        return replace(recording, camera=camera)


def seen_points(world: World, head: HeadStream, look_round: bool, rng: np.random.Generator) -> PointCloud:
    """Semi-dense points along the head's path.

    With `look_round`, points that the wearer sees from the start of the path are available from its first frame.
    """
    points = semidense_points(world.mesh, world.face_texture, _turned_round(head) if look_round else head, rng)
    assert points.first_seen is not None
    return replace(points, first_seen=points.first_seen.clamp(min=head.timestamps[0].item()))


def _turned_round(head: HeadStream) -> HeadStream:
    """The path preceded by two turns on the spot, one level and one looking down."""
    ahead = head.R_world_device[0, :, 0]
    yaw = torch.atan2(ahead[1], ahead[0]) + torch.arange(TURNS) * (2 * torch.pi / TURNS)
    down = torch.tensor(DOWN_DEG).deg2rad().to(yaw.dtype)
    R = (rotation.about_axis("z", yaw)[None] @ rotation.about_axis("y", down)[:, None]).flatten(0, 1)
    before = head.timestamps[0] - VIEW_S * torch.arange(len(R), 0, -1, dtype=torch.float64)
    return replace(
        head,
        timestamps=torch.cat([before, head.timestamps]),
        R_world_device=torch.cat([R.to(head.R_world_device.dtype), head.R_world_device]),
        t_world_device=torch.cat([head.t_world_device[:1].expand(len(R), 3), head.t_world_device]),
    )


def cmu_surrounded_tasks(
    source: str | Path, output: str | Path, splits: Splits, camera: bool, look_round: bool, seed: int
) -> list[Task]:
    """One task per recording of the data set `source`, which `wearcap prepare cmu` made (floors at z = 0).

    Videos of the head camera go to `output`/videos. The hash covers the recording and the simulator's own source.
    """
    store, simulator = RecordingStore.open(source), source_files()
    tasks = []
    for name in store.names():
        entry = store.entries[name]
        make = Surrounded(store.root / entry.file, name, Path(output), camera, look_round, seed)
        made = content_hash(entry.sha256, camera, look_round, seed, simulator)
        tasks.append(Task(name, make, splits.of(entry.subject), made))
    return tasks
