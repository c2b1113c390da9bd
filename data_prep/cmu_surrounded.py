"""CMU's motion in simulated rooms and streets that fit it, with SLAM points and a head camera's video."""

import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from data_prep.shared.engine import Splits, Task
from data_prep.simulated import source_files
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearsim.places.surround import surround
from wearsim.rendering.ego_view import write_ego_video
from wearsim.sensors.slam import semidense_points

TURNS, DOWN_DEG, VIEW_S = 12, (0.0, 38.0), 0.25
"""Steps per turn, pitch of each turn (°), duration of a step (s) of the wearer's turns on the spot before the recording."""


def _surrounded(file: Path, name: str, root: Path, camera: bool, look_round: bool, seed: int) -> Recording:
    """One recording in its simulated surroundings, with semi-dense points along the head's path and, with `camera`, a video.

    With `look_round`, points that the wearer sees from the start of the path are available from its first frame.
    """
    recording = RecordingFile(file).load()
    motion, head = recording.motion, recording.head
    if motion is None or head is None:
        raise WearcapError("no motion or no head path", where=file, expected="motion capture with both")
    key = [seed, zlib.crc32(name.encode())]
    of_world, of_points, of_camera = (np.random.default_rng([number, *key]) for number in (31, 32, 33))
    world = surround(motion, of_world, f"cmu-room-{name}")
    path = head
    if look_round:  # the path is preceded by two turns on the spot, one level and one looking down
        ahead = head.R_world_device[0, :, 0]
        yaw = torch.atan2(ahead[1], ahead[0]) + torch.arange(TURNS) * (2 * torch.pi / TURNS)
        down = torch.tensor(DOWN_DEG).deg2rad().to(yaw.dtype)
        R = (rotation.about_axis("z", yaw)[None] @ rotation.about_axis("y", down)[:, None]).flatten(0, 1)
        before = head.timestamps[0] - VIEW_S * torch.arange(len(R), 0, -1, dtype=torch.float64)
        path = replace(
            head,
            timestamps=torch.cat([before, head.timestamps]),
            R_world_device=torch.cat([R.to(head.R_world_device.dtype), head.R_world_device]),
            t_world_device=torch.cat([head.t_world_device[:1].expand(len(R), 3), head.t_world_device]),
        )
    points = semidense_points(world.mesh, world.face_texture, path, of_points)
    assert points.first_seen is not None
    points = replace(points, first_seen=points.first_seen.clamp(min=head.timestamps[0].item()))
    recording = replace(recording, points=points, location=world.name)
    if not camera:
        return recording
    video = root / "videos" / f"{name}.mp4"
    stream = write_ego_video(video, world, motion, recording.shape, head.t_head_device, of_camera)
    return replace(recording, camera=stream)


def _evenly(names: list[str], count: int) -> list[str]:
    return [names[k * len(names) // count] for k in range(count)] if count < len(names) else names


def cmu_surrounded_tasks(
    output: str | Path,
    splits: Splits,
    source: str | Path = "datasets/cmu",  # data set made by `wearcap prepare cmu`
    camera: bool = True,  # film the wearer's view (videos/NAME.mp4)
    # the wearer has turned round on the spot before a recording begins, so that points are available
    look_round: bool = True,
    seed: int = 0,
    # so many of each split, evenly chosen, such as {val: 8, test: 24}; null: all
    recordings: Mapping[str, int] | None = None,
) -> list[Task]:
    """One task per recording of the data set `source`, which `wearcap prepare cmu` made (floors at z = 0), or for
    `recordings[split]` of each split, evenly chosen.

    Videos of the head camera go to `output`/videos. The hash covers the recording and the simulator's own source.
    """
    store, simulator = RecordingStore.open(source), source_files()
    names = store.names()
    if recordings is not None:
        in_split = {
            split: [n for n in names if splits.of(store.entries[n].context.subject) == split] for split in recordings
        }
        names = [name for split, count in recordings.items() for name in _evenly(in_split[split], count)]
    tasks = []
    for name in names:
        entry = store.entries[name]
        make = partial(_surrounded, store.root / entry.file, name, Path(output), camera, look_round, seed)
        key = content_hash(entry.sha256, camera, look_round, seed, simulator)
        tasks.append(Task(name, make, splits.of(entry.context.subject), key))
    return tasks
