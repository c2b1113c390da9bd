"""Pictures of a checkerboard as a given camera would take them, for tests."""

import functools

import cv2
import numpy as np
import torch

from wearcap.geometry.camera import Camera
from wearcap.localization.checkerboard import Board

CAMERA = Camera("opencv", 480, 360, 339.0, 343.5, 244.6, 177.2, (-0.25, 0.08, 1.2e-3, -0.8e-3))
BOARD = Board(8, 5, 0.03)
_OVERSAMPLING = 2


@functools.lru_cache
def rays_of(camera: Camera) -> np.ndarray:
    """Rays of all subpixels: (subpixel y, subpixel x, 3)."""
    x, y = (torch.arange(n, dtype=torch.float64) for n in (camera.width, camera.height))
    rays = camera.unproject(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)).nan_to_num(0.0).float().numpy()
    return cv2.resize(rays, None, fx=_OVERSAMPLING, fy=_OVERSAMPLING)


def pose(random: np.random.Generator, board: Board, tilt_deg: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """(R_cam_board, t_cam_board) of a board that is held before the camera."""
    turn = cv2.Rodrigues(np.radians(random.uniform(-tilt_deg, tilt_deg, 3) * (1, 1, 0.5)))[0]
    far = random.uniform(0.25, 0.55)
    centre = np.array([random.uniform(-0.45, 0.45) * far, random.uniform(-0.35, 0.35) * far, far])
    return turn, centre - turn @ board.points.mean(0)


def picture(
    rays: np.ndarray, board: Board, R: np.ndarray, t: np.ndarray, blur_px: float = 0.0, seed: int = 0
) -> np.ndarray:
    """RGB picture of squares with a white margin on a grey wall, with a little noise."""
    homography = np.linalg.inv(np.stack([R[:, 0] * board.square_m, R[:, 1] * board.square_m, t], 1))
    u, v, w = np.moveaxis(rays @ homography.T.astype(np.float32), -1, 0)
    ahead = w > 1e-6
    w = np.where(ahead, w, 1)
    u, v = u / w, v / w
    squares = (u > -1) & (u < board.columns) & (v > -1) & (v < board.rows)
    margin = (u > -2) & (u < board.columns + 1) & (v > -2) & (v < board.rows + 1)
    black = squares & ((np.floor(u) + np.floor(v)) % 2 == 0)
    shade = np.where(black, np.float32(25), np.where(margin, np.float32(225), np.float32(120)))
    shade[~ahead] = 120
    h, w = (n // _OVERSAMPLING for n in shade.shape)
    shade = shade.reshape(h, _OVERSAMPLING, w, _OVERSAMPLING).mean((1, 3))
    if blur_px:
        shade = cv2.GaussianBlur(shade, None, blur_px)
    noisy = shade + np.random.default_rng(seed).normal(0, 2, shade.shape)
    return np.repeat(noisy.clip(0, 255).astype(np.uint8)[..., None], 3, -1)


def pictures(
    count: int, camera: Camera = CAMERA, board: Board = BOARD, seed: int = 0, **options
) -> list[tuple[str, np.ndarray]]:
    """Named pictures from random poses; the tilt is an option of `pose`."""
    random, rays = np.random.default_rng(seed), rays_of(camera)
    tilt = {"tilt_deg": options.pop("tilt_deg")} if "tilt_deg" in options else {}
    return [
        (f"{k:03d}.png", picture(rays, board, *pose(random, board, **tilt), seed=k, **options)) for k in range(count)
    ]
