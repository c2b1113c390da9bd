"""A room of painted walls as a cloud, and photos of it: a scene in which every place looks different."""

from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.point_map import PointMapper
from wearcap.scene.scan import Photo, Scan

SIZE = np.array([5.0, 4.0, 2.6])
CAMERA = Camera("opencv", 400, 300, 260.0, 262.0, 198.0, 151.0, (-0.04, 0.01, 0.001, -0.0008))


def painting(rows: int, columns: int, random: np.random.Generator) -> np.ndarray:
    """Rectangles of all sizes over one another."""
    picture = np.full((rows, columns, 3), 128, np.uint8)
    for size in np.geomspace(0.6, 0.015, 900):
        extent = np.maximum(2, size * min(rows, columns) * random.uniform(0.4, 1.6, 2)).astype(int)
        corner = (random.uniform(-0.2, 1.0, 2) * [rows, columns]).astype(int)
        start = np.maximum(corner, 0)
        stop = np.maximum(corner + extent, 0)
        picture[start[0] : stop[0], start[1] : stop[1]] = random.integers(0, 256, 3)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


def textured_room(spacing: float = 0.012, seed: int = 0) -> Scan:
    """The six faces of a box with one corner at the world's origin."""
    random = np.random.default_rng(seed)
    points, colors = [], []
    for axis in range(3):
        sides = [side for side in range(3) if side != axis]
        counts = np.round(SIZE[sides] / spacing).astype(int)
        grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 2) * spacing
        for end in (0.0, SIZE[axis]):
            face = np.full((len(grid), 3), end)
            face[:, sides] = grid
            points.append(face)
            colors.append(painting(*counts.tolist(), random).reshape(-1, 3))
    return Scan(np.concatenate(points).astype(np.float32), np.concatenate(colors))


def looking(position: tuple[float, float, float], yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Rigid:
    """Pose of an OpenCV camera that looks along yaw (from x to y) and down by pitch (rad)."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    forward = np.array([cy * cp, sy * cp, -sp])
    right = np.array([sy, -cy, 0.0])
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    return Rigid(torch.tensor(np.stack([right, down, forward], 1)), torch.tensor(position, dtype=torch.float64))


def color_picture(mapper: PointMapper, camera: Camera, T_world_cam: Rigid) -> np.ndarray:
    """The scan's colours as the camera sees them, black where nothing is."""
    index = mapper(camera, T_world_cam).index
    return np.where(index[..., None] >= 0, mapper.scan.colors[np.maximum(index, 0)], 0).astype(np.uint8)


def photograph(mapper: PointMapper, camera: Camera, T_world_cam: Rigid) -> np.ndarray:
    """The scan's colours, drawn at twice the size and averaged."""
    fine = camera.scaled(2 * camera.width, 2 * camera.height)
    picture = color_picture(mapper, fine, T_world_cam)
    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def photo_poses(count: int, seed: int = 1) -> list[Rigid]:
    """Cameras here and there at the height of a standing person."""
    random = np.random.default_rng(seed)
    return [
        looking(
            (*random.uniform([1.0, 1.0, 1.3], SIZE - [1.0, 1.0, 0.8]),),
            2 * np.pi * number / count * 2.4,
            random.uniform(-0.2, 0.3),
        )
        for number in range(count)
    ]


def take_photos(mapper: PointMapper, camera: Camera, poses: list[Rigid], folder: Path) -> list[Photo]:
    """Photos on disk."""
    photos = []
    for number, pose in enumerate(poses):
        file = folder / f"{number:05}.png"
        Image.fromarray(photograph(mapper, camera, pose)).save(file)
        photos.append(Photo(file, camera, pose))
    return photos
