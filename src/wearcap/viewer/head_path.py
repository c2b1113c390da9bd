"""A picture of a recording that has no motion: the head's path among its points, from above and aside."""

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.geometry.render import Splats, render
from wearcap.geometry.rigid import Rigid
from wearcap.recording.recording import Recording
from wearcap.viewer.picture import SKY, captioned

PATH_COLOR, LOOK_COLOR = (0.85, 0.35, 0.12), (0.15, 0.35, 0.70)
LOOKS = 12
"""Number of viewing directions drawn along the path."""


def draw_head_path(recording: Recording, size: tuple[int, int] = (640, 520)) -> UInt8[np.ndarray, "height width 3"]:
    """Two panels of `size` (width, height). Raises WearcapError if there is no head path either."""
    if recording.head is None:
        raise WearcapError("nothing to draw", where=recording.name, expected="a motion, or a head's path")
    path = recording.head.t_world_device.double().numpy()
    points = np.zeros((0, 3)) if recording.points is None else recording.points.points_world.double().numpy()
    cloud = np.concatenate([path, points])
    low, high = np.quantile(cloud, 0.02, 0), np.quantile(cloud, 0.98, 0)
    centre, radius = (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1.0)
    splats = Splats(points.astype(np.float32), _by_height(points, low[2], high[2]), 0.8)
    panels = []
    for caption, direction in (("from above", (0.02, 0.05, -1.0)), ("aside", (-0.6, 0.75, -0.35))):
        camera, T_world_cam = _looking(direction, centre, 2.4 * radius, size)
        frame = render(camera, T_world_cam, [_path_mesh(recording, path, radius)], [splats], background=SKY)
        panels.append(np.asarray(captioned(frame.color, f"{recording.name}, {caption}")))
    return np.asarray(Image.fromarray(np.concatenate(panels, 1)))


def _path_mesh(recording: Recording, path: np.ndarray, radius: float) -> Mesh:
    """The path as a tube, with short rods along the viewing directions."""
    assert recording.head is not None
    steps = path[:: max(1, len(path) // 300)]
    at = np.linspace(0, len(path) - 1, LOOKS).astype(int)
    ahead = recording.head.R_world_device[torch.from_numpy(at)][:, :, 0].double().numpy()
    start = np.concatenate([steps[:-1], path[at]])
    end = np.concatenate([steps[1:], path[at] + 0.12 * radius * ahead])
    thick = np.full(len(start), 0.006 * radius)
    colors = np.concatenate([np.tile(PATH_COLOR, (len(steps) - 1, 1)), np.tile(LOOK_COLOR, (LOOKS, 1))])
    return capsules(start, end, thick, thick, colors, 8)


def _by_height(points: np.ndarray, low: float, high: float) -> np.ndarray:
    share = np.clip((points[:, 2:] - low) / max(high - low, 1e-6), 0, 1)
    return ((1 - share) * [0.35, 0.45, 0.55] + share * [0.80, 0.68, 0.45]).astype(np.float32)


def _looking(direction, centre: np.ndarray, distance: float, size: tuple[int, int]) -> tuple[Camera, Rigid]:
    forward = np.array(direction) / np.linalg.norm(direction)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    focal = 1.0 * size[1]
    camera = Camera("pinhole", *size, focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return camera, Rigid(torch.from_numpy(R).float(), torch.from_numpy(centre - distance * forward).float())
