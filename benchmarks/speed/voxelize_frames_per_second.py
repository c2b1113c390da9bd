"""Grids of the points around the body per second on one core, in a map of a million points.

First figure: a recording of 15 minutes (54,000 frames), the whole cloud in one call, each point from when it was seen,
the cloud's sorting included. Second: a map to which every frame adds the points seen since the last, one frame
after another as when streaming (its last minute, when it is largest). A flat of 108 m2 whose points lie on floor,
walls and furniture. value: frames per second of one thread's own time; baseline: the recording's 60. ratio = value /
baseline; the goal is for `value`.
"""

import time

import torch

from benchmarks.speed import planted_flat
from benchmarks.speed.figures import figure
from wearcap.scene.voxels import VoxelMap, voxelize

FPS = 60.0


def measure(points: int = 1_000_000, frames: int = 54_000) -> list[dict]:
    cloud, pose = planted_flat.flat(points), planted_flat.stroll(frames)
    now = torch.arange(frames, dtype=torch.float64) / FPS
    seen = torch.linspace(0, frames / FPS, points, dtype=torch.float64)
    voxelize(cloud[:100], pose[:2], first_seen=seen[:100], timestamps=now[:2])
    begin = time.thread_time()
    voxelize(cloud, pose, first_seen=seen, timestamps=now)
    whole = frames / (time.thread_time() - begin)

    growing, last = VoxelMap(), min(frames, 3600)
    new = torch.searchsorted(seen, now, right=True).tolist()
    growing.add(cloud[: new[-last]])
    begin = time.thread_time()
    for frame in range(frames - last + 1, frames):
        growing.add(cloud[new[frame - 1] : new[frame]])
        growing.voxelize(pose[frame : frame + 1])
    streamed = (last - 1) / (time.thread_time() - begin)
    return [
        figure("voxelize_frames_per_second", value, unit, FPS, value / FPS, 1000.0)
        for value, unit in ((whole, "frames/s, whole recording"), (streamed, "frames/s, growing map"))
    ]
