"""Points of a scan drawn into a point map per second on one core, against plain vectorised NumPy.

First figure: 2 million points, all of them before an OpenCV camera of 960 x 540 pixels at 2 to 8 m; discs of 1 cm
radius; nothing to pass over. Baseline: projection by matrix products and a z-buffer by sorting, one pixel per point
(no discs). Second: a building of 10 rooms, 10 million points, of which the camera's room is all it can use; value
and baseline count every point of the cloud. value and baseline: million points per second of one thread's own time
(so that other programs do not count), median of turns taken in one run. ratio = value / baseline; the goal is for `value`.
"""

import statistics
import time

import numpy as np
import torch

from benchmarks.speed.figures import figure
from wearcap.geometry.camera import Camera
from wearcap.geometry.render import SplatCloud
from wearcap.geometry.rigid import Rigid

CAMERA = Camera("opencv", 960, 540, 520.0, 520.0, 479.5, 269.5, (-0.05, 0.01, 0.0005, -0.0003))
FORWARD = Rigid(torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), torch.zeros(3))
"""Looking along the world's x, z up."""
SPLAT_M = 0.01


def before_the_camera(count: int) -> np.ndarray:
    """Points on surfaces at 2 to 8 m that fill the picture."""
    random = np.random.default_rng(0)
    depth = random.choice([2.0, 3.0, 5.0, 8.0], count) + random.normal(0, 0.003, count)
    side, up = random.uniform(-0.88, 0.88, count), random.uniform(-0.48, 0.48, count)
    return np.stack([depth, depth * side, depth * up], -1).astype(np.float32)


def building(count: int, rooms: int = 10) -> np.ndarray:
    """The walls, floor and ceiling of rooms of 5 x 4 x 2.5 m in a row along y."""
    random = np.random.default_rng(1)
    place = random.uniform(-1, 1, (count, 3)) * [2.5, 2.0, 1.25]
    axis = random.integers(0, 3, count)
    rows = np.arange(count)
    place[rows, axis] = np.sign(place[rows, axis]) * np.array([2.5, 2.0, 1.25])[axis]
    place[:, 1] += 4.0 * random.integers(0, rooms, count)
    return place.astype(np.float32)


def with_numpy(points: np.ndarray) -> np.ndarray:
    """The baseline: project everything, sort by depth, write one pixel per point, the nearest last."""
    pose = FORWARD.to(torch.float64).inverse().matrix()[:3].numpy()
    cam = points @ pose[:, :3].T.astype(np.float32) + pose[:, 3].astype(np.float32)
    cam, number = cam[cam[:, 2] > 0.02], np.flatnonzero(cam[:, 2] > 0.02)
    x, y = cam[:, 0] / cam[:, 2], cam[:, 1] / cam[:, 2]
    k1, k2, p1, p2 = CAMERA.distortion
    s = x * x + y * y
    gain = 1 + s * (k1 + s * k2)
    u = CAMERA.fx * (x * gain + 2 * p1 * x * y + p2 * (s + 2 * x * x)) + CAMERA.cx
    v = CAMERA.fy * (y * gain + p1 * (s + 2 * y * y) + 2 * p2 * x * y) + CAMERA.cy
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < CAMERA.width) & (row < CAMERA.height)
    order = np.flatnonzero(inside)[np.argsort(-cam[inside, 2])]
    index = np.full((CAMERA.height, CAMERA.width), -1, np.int32)
    index[row[order], column[order]] = number[order]
    return index


def measure(view: int = 2_000_000, whole: int = 10_000_000, turns: int = 5) -> list[dict]:
    figures = []
    for points, unit in (
        (before_the_camera(view), "M points/s in view"),
        (building(whole), "M points/s of a building"),
    ):
        cloud = SplatCloud.build(points)
        ours, theirs = [], []
        cloud.draw(CAMERA, FORWARD, SPLAT_M)
        for _ in range(turns):
            begin = time.thread_time()
            cloud.draw(CAMERA, FORWARD, SPLAT_M)
            middle = time.thread_time()
            with_numpy(points)
            ours.append(middle - begin)
            theirs.append(time.thread_time() - middle)
        value, baseline = (len(points) / 1e6 / statistics.median(side) for side in (ours, theirs))
        figures.append(figure("splat_mpoints_per_second", value, unit, baseline, value / baseline, 5.0))
    return figures
