"""Point maps, the visible scan point of each pixel of a photo (thesis 4.2.1), for lifting keypoints to 3D; and pictures
before features are sought in them: of the calibrated size, and undistorted where the camera is a fisheye.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from wearcap.errors import WearcapError
from wearcap.extras import at_first_use
from wearcap.geometry.camera import Camera
from wearcap.geometry.render import SplatCloud
from wearcap.geometry.rigid import Rigid
from wearcap.localization.features import Extractor, Features
from wearcap.scene.scan import Scan

cv2 = at_first_use("cv2", "localisation")


@dataclass(frozen=True, eq=False)
class _PointMap:
    """Visible scan points and depths of a camera."""

    camera: Camera
    T_world_cam: Rigid
    index: Int32[np.ndarray, "height width"]
    """Index of the visible scan point; -1 where there is none."""
    depth: Float32[np.ndarray, "height width"]
    """Depth along the optical axis (m), for fisheyes along the ray; infinite where there is no point."""

    def lift(
        self, points: Float32[np.ndarray, "point 3"], keypoints: Float32[np.ndarray, "keypoint 2"]
    ) -> tuple[Float32[np.ndarray, "keypoint 3"], Bool[np.ndarray, "keypoint"]]:
        """World position (m) under each keypoint, and where it is valid.

        The position is where the keypoint's ray meets the plane through the scan points seen in the 5 x 5 pixels
        around it. Keypoints at depth edges are refused: those with an empty pixel there, or whose depths differ by
        more than 6 % (a wall seen at 10° differs by 3 % at a focal length of 800 pixels).
        """
        height, width = self.index.shape
        cell = np.rint(keypoints).astype(np.int64)
        inside = (cell >= 2).all(1) & (cell[:, 0] < width - 2) & (cell[:, 1] < height - 2)
        column, row = np.where(inside[:, None], cell, 2).T
        window = np.arange(-2, 3)
        where = row[:, None, None] + window[:, None], column[:, None, None] + window
        nearest, furthest = (reduce(self.depth[where], axis=(1, 2)) for reduce in (np.min, np.max))
        valid = inside & np.isfinite(furthest) & (furthest < 1.06 * nearest)
        rays = self.camera.unproject(torch.from_numpy(keypoints.astype(np.float64)))
        rays = (self.T_world_cam.R.double().cpu() @ rays[..., None])[..., 0].numpy()
        center = self.T_world_cam.t.double().cpu().numpy()
        around = points[np.where(valid[:, None, None], self.index[where], 0)].reshape(-1, 25, 3)
        # Where each ray from the camera meets the plane through its points; without a plane (points in a line) or with one
        # that it grazes, where the ray passes the middle of them
        apart = around - center
        middle = apart.mean(1)
        spread = np.einsum("rpi,rpj->rij", apart - middle[:, None], apart - middle[:, None])
        sizes, axes = np.linalg.eigh(spread)
        normal = axes[..., 0]
        slope = (normal * rays).sum(1)
        flat = (sizes[:, 1] > 10 * np.abs(sizes[:, 0])) & (sizes[:, 1] > 1e-3 * sizes[:, 2])
        usable = flat & (np.abs(slope) > 0.1)
        distance = np.where(usable, (normal * middle).sum(1) / np.where(usable, slope, 1), (middle * rays).sum(1))
        positions = center + rays * distance[:, None]
        valid &= np.isfinite(positions).all(1)
        return np.where(valid[:, None], positions, 0).astype(np.float32), valid


class PointMapper:
    """Draws point maps of one scan.

    `splat_m`: radius (m) of the disc that stands for a scan point, the same for all: a bit more than half the
    distance between neighbouring points closes surfaces.
    """

    def __init__(self, scan: Scan, splat_m: float = 0.015):
        if not splat_m > 0:
            raise WearcapError(f"splats of {splat_m} m", expected="a positive radius")
        self.scan, self.splat_m = scan, splat_m
        self._cloud = SplatCloud.build(scan.points)

    def __call__(self, camera: Camera, T_world_cam: Rigid) -> _PointMap:
        return _PointMap(camera, T_world_cam, *self._cloud.draw(camera, T_world_cam, self.splat_m))


@dataclass(frozen=True, eq=False)
class _Undistortion:
    """A remap of pictures and point maps of one camera onto a fixed pinhole camera with the same optical axis."""

    camera: Camera
    """The perspective camera of the remapped image."""
    x: Float32[np.ndarray, "height width"]
    """Position of each remapped pixel in the original; -1 outside the original."""
    y: Float32[np.ndarray, "height width"]
    axis_share: Float64[np.ndarray, "height width"]
    """Depth along the optical axis per distance along the ray, for each pixel."""

    @property
    def valid(self) -> Bool[np.ndarray, "height width"]:
        """Pixels that are inside the original."""
        return self.x >= 0

    def image(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
        return cv2.remap(image, self.x, self.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)

    def point_map(self, point_map: _PointMap) -> _PointMap:
        """The point map with the nearest original pixel's point in each, its depths along the optical axis."""
        column, row = (np.where(self.valid, np.rint(side), 0).astype(np.int64) for side in (self.x, self.y))
        index = np.where(self.valid, point_map.index[row, column], -1).astype(np.int32)
        depth = np.where(self.valid, point_map.depth[row, column], np.inf)
        if point_map.camera.is_fisheye:
            depth = depth * self.axis_share
        return _PointMap(self.camera, point_map.T_world_cam, index, depth.astype(np.float32))


@lru_cache(maxsize=16)
def undistortion(camera: Camera, horizontal_fov_deg: float = 100.0) -> _Undistortion:
    """The remap of a camera's pictures onto a pinhole one of the same size, centred, with square pixels.

    Raises WearcapError for a field of view that no pinhole camera has.
    """
    if not 10 <= horizontal_fov_deg <= 150:
        raise WearcapError(f"a perspective view of {horizontal_fov_deg}°", expected="10° to 150°")
    width, height = camera.width, camera.height
    focal = width / 2 / math.tan(math.radians(horizontal_fov_deg) / 2)
    flat = Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    grid = torch.stack(torch.meshgrid(*(torch.arange(n).double() for n in (width, height)), indexing="xy"), -1)
    rays = flat.unproject(grid)
    pixels, seen = camera.project(rays)
    # Half a pixel around the picture counts as seen: the outermost pixels' centres are taken for it.
    pixels = torch.minimum(pixels.clamp(min=0), pixels.new_tensor([width - 1, height - 1]))
    x, y = torch.where(seen[..., None], pixels, -1.0).float().unbind(-1)
    return _Undistortion(flat, x.contiguous().numpy(), y.contiguous().numpy(), rays[..., 2].contiguous().numpy())


def described(
    image: UInt8[np.ndarray, "height width 3"],
    camera: Camera,
    extractor: Extractor,
    horizontal_fov_deg: float,
    where: str,
) -> tuple[np.ndarray, Camera, Features]:
    """Picture, camera and features; all of the undistorted picture where the camera is a fisheye.

    Keypoints beyond the border of what a fisheye saw are left out. Raises WearcapError as `check_size`.
    """
    check_size(image, camera, where)
    if not camera.is_fisheye:
        return image, camera, extractor(image)
    remap = undistortion(camera, horizontal_fov_deg)
    image = remap.image(image)
    features = extractor(image)
    # Six pixels from the border
    inside = cv2.erode(remap.valid.astype(np.uint8), np.ones((13, 13), np.uint8), borderValue=0) > 0
    column, row = np.rint(features.keypoints).astype(np.int64).T
    kept = inside[row.clip(0, inside.shape[0] - 1), column.clip(0, inside.shape[1] - 1)]
    return image, remap.camera, features.subset(kept)


def check_size(image: UInt8[np.ndarray, "height width 3"], camera: Camera, where: str) -> None:
    """Raises WearcapError when a picture has not the size that its camera was calibrated for."""
    if image.shape[:2] != (camera.height, camera.width):
        raise WearcapError(
            f"a picture of {image.shape[1]}x{image.shape[0]} pixels with a calibration for "
            f"{camera.width}x{camera.height}",
            where=where,
            expected="the size that the camera was calibrated at",
            fix="Resize the calibration with it (Camera.scaled), or take the original pictures.",
        )
