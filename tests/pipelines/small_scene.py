"""A coloured room on disk with photos taken in it, for tests; nothing is rendered."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.camera_json import write_photos
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.scene.scan import Photo

LEVEL = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""An OpenCV camera that looks along the world's x."""


def room_cloud(spacing_m: float = 0.025) -> np.ndarray:
    """Floor of 6 x 4 m and its walls, 2.5 m high."""
    x, y, z = (np.arange(0, side, spacing_m) for side in (6.0, 4.0, 2.5))
    faces = [np.stack(np.meshgrid(x, y, [0.0]), -1)]
    faces += [np.stack(np.meshgrid(x, [end], z), -1) for end in (0.0, 4.0)]
    faces += [np.stack(np.meshgrid([end], y, z), -1) for end in (0.0, 6.0)]
    return np.concatenate([face.reshape(-1, 3) for face in faces]).astype(np.float32)


def write_room(folder: Path, *, unit: float = 1.0, colors: bool = True, photos: int = 4) -> list[Photo]:
    """pointcloud.ply, photos.json and plain grey images."""
    points = room_cloud() * np.float32(unit)
    paint = np.random.default_rng(0).integers(0, 255, points.shape, dtype=np.uint8)
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    write_ply(Ply(points, paint if colors else None), folder / "pointcloud.ply")
    camera = Camera("fisheye", 80, 60, 25.0, 25.0, 39.5, 29.5, (0.0, 0.0, 0.0, 0.0))
    taken = []
    for k in range(photos):
        R = about_axis("z", torch.tensor(1.5 * k)) @ LEVEL
        file = folder / "photos" / f"{k:05d}-cam0.jpg"
        Image.new("RGB", (camera.width, camera.height), (120, 120, 120)).save(file)
        taken.append(Photo(file, camera, Rigid(R, torch.tensor([2.0 + 0.4 * k, 2.0, 1.7]))))
    write_photos(taken, folder)
    return taken


def inverted(photos: list[Photo]) -> list[Photo]:
    """World-to-camera poses under the name of camera-to-world ones."""
    return [replace(photo, T_world_cam=photo.T_world_cam.inverse()) for photo in photos]
