"""Camera poses per second at 960 x 540 in a map of 504 pictures, against matching picture with picture.

A building of nine painted rooms, scanned at 15 mm; 56 database pictures (640 x 360) in each, lifted to 3D by point
maps; 24 frames of a walk through three rooms as queries. First figure: a video, the last pose helping to choose
database pictures. Second: every picture on its own, 40 retrieved. Baseline of both: the paper's method, the
query's keypoints paired with those of each of the 40 retrieved pictures in turn (mutual nearest neighbours, OpenCV's brute
force), then the same RANSAC; features are the same. value and baseline: frames per second on 2 threads, features included, decoding not;
frames without a pose within 5 cm and 0.5° of the truth stop the benchmark. ratio = value / baseline; the goal is for
`value`. The map is kept in outputs/benchmarks.
"""

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from benchmarks.speed.figures import figure
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.features import Features, RootSift
from wearcap.localization.localizer import Localizer, localize_video
from wearcap.localization.map_builder import MapSettings, build_map
from wearcap.localization.point_map import PointMapper
from wearcap.localization.visual_map import VisualMap
from wearcap.scene.scan import Photo, Scan

ROOM_M = np.array([6.0, 5.0, 2.6])
ROOMS, PER_ROOM, SPACING_M = 9, 56, 0.015
DATABASE = Camera.pinhole(640, 360, 58.0)
QUERY = Camera("opencv", 960, 540, 560.0, 560.0, 481.0, 268.0, (-0.06, 0.01, 0.0005, -0.0004))
EXTRACTOR = RootSift(1200, max_side=640)
"""Pictures of 960 x 540 are searched at two thirds of their size, the database's as they are."""
MAP = Path("outputs/benchmarks/nine_rooms.safetensors")


def painting(shape: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Rectangles of all sizes over one another, on plaster."""
    picture = np.full((*shape, 3), 150, np.uint8)
    for size in np.geomspace(0.5, 0.02, 300):
        extent = np.maximum(2, size * min(shape) * random.uniform(0.4, 1.6, 2)).astype(int)
        top, left = (random.uniform(0, 1, 2) * shape).astype(int)
        picture[top : top + extent[0], left : left + extent[1]] = random.integers(0, 256, 3)
    return cv2.GaussianBlur(picture, (0, 0), 0.8)


def building() -> Scan:
    """Rooms in a row along x, each with six painted faces."""
    random = np.random.default_rng(0)
    points, colors = [], []
    for room in range(ROOMS):
        for axis in range(3):
            sides = [side for side in range(3) if side != axis]
            counts = np.round(ROOM_M[sides] / SPACING_M).astype(int)
            grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 2)
            for end in (0.05, ROOM_M[axis] - 0.05):
                face = np.full((len(grid), 3), end)
                face[:, sides] = grid * SPACING_M
                face[:, 0] += room * ROOM_M[0]
                points.append(face + random.normal(0, 0.002, face.shape))
                colors.append(painting((counts[0], counts[1]), random).reshape(-1, 3))
    return Scan(np.concatenate(points).astype(np.float32), np.concatenate(colors))


def looking(x: float, y: float, z: float, yaw: float, pitch: float) -> Rigid:
    """Pose of an OpenCV camera that looks along yaw and down by pitch (rad)."""
    turn = rotation.about_axis("z", torch.tensor(yaw).double()) @ rotation.about_axis("y", torch.tensor(pitch).double())
    axes = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    return Rigid(turn @ axes, torch.tensor([x, y, z], dtype=torch.float64))


def database_poses() -> list[Rigid]:
    random = np.random.default_rng(1)
    return [
        looking(
            room * ROOM_M[0] + random.uniform(1.2, 4.8),
            random.uniform(1.2, 3.8),
            random.uniform(1.4, 1.9),
            2 * np.pi * k / PER_ROOM * 5,
            random.uniform(-0.2, 0.3),
        )
        for room in range(ROOMS)
        for k in range(PER_ROOM)
    ]


def walk(count: int) -> list[Rigid]:
    """Frames at 30 Hz, eight in each of three rooms."""
    return [
        looking(6.0 * (4 * (k // 8) % ROOMS) + 1.8 + 0.04 * (k % 8), 2.0 + 0.02 * (k % 8), 1.65, 0.4 + k // 8 + 0.03 * (k % 8), 0.1)
        for k in range(count)
    ]  # fmt: skip


def picture(mapper: PointMapper, camera: Camera, pose: Rigid) -> np.ndarray:
    index = mapper(camera, pose).index
    colors = np.where(index[..., None] >= 0, mapper.scan.colors[np.maximum(index, 0)], 0)
    return cv2.GaussianBlur(colors.astype(np.uint8), (0, 0), 0.6)


def mapped(mapper: PointMapper, scan: Scan) -> VisualMap:
    """The map of the building: from its file, else built (a few minutes)."""
    if MAP.is_file():
        return VisualMap.load(MAP)
    with tempfile.TemporaryDirectory() as folder:
        photos = []
        for number, pose in enumerate(database_poses()):
            file = Path(folder) / f"{number:05}.jpg"
            Image.fromarray(picture(mapper, DATABASE, pose)).save(file, quality=92)
            photos.append(Photo(file, DATABASE, pose))
        built = build_map(photos, scan, EXTRACTOR, settings=MapSettings(splat_m=0.012), progress=True)
    built.save(MAP)
    return built


def brute_force(query: Features, other: Features) -> np.ndarray:
    """Mutual nearest neighbours of descriptors."""
    matches = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(query.descriptors, other.descriptors)
    return np.array([(match.queryIdx, match.trainIdx) for match in matches], np.int64).reshape(-1, 2)


def check(t_world_cam: torch.Tensor, R_world_cam: torch.Tensor, truth: list[Rigid]) -> None:
    for t, R, pose in zip(t_world_cam, R_world_cam, truth):
        shift = (t.double() - pose.t).norm().item()
        turn = rotation.log(R.double().T @ pose.R).norm().rad2deg().item()
        if shift > 0.05 or turn > 0.5:
            raise SystemExit(f"error: a pose is off by {100 * shift:.1f} cm and {turn:.2f}°")


def measure(frames: int = 24, baseline_frames: int = 4) -> list[dict]:
    scan = building()
    mapper = PointMapper(scan, 0.012)
    visual_map = mapped(mapper, scan)
    truth = walk(frames)
    images = [picture(mapper, QUERY, pose) for pose in truth]
    localizer, pairwise = Localizer(visual_map, EXTRACTOR), Localizer(visual_map, EXTRACTOR, brute_force)
    localizer(images[0], QUERY)
    rates = []
    for one_by_one in (False, True):
        begin = time.perf_counter()
        found = localize_video(images, torch.arange(frames).double() / 30, QUERY, localizer, use_prior=not one_by_one)
        rates.append(frames / (time.perf_counter() - begin))
        check(found.t_world_cam, found.R_world_cam, truth)
    begin = time.perf_counter()
    for image in images[:: max(1, frames // baseline_frames)][:baseline_frames]:
        pairwise(image, QUERY)
    baseline = baseline_frames / (time.perf_counter() - begin)
    return [
        figure("localization_frames_per_second", value, f"frames/s, {unit}", baseline, value / baseline, 5.0)
        for value, unit in zip(rates, ("video", "single pictures"))
    ]
