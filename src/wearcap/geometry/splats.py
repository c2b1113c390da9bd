"""Point clouds rendered as discs of one size, for maps, simulated cameras and pictures of a scan.

A cloud is cut once into blocks of neighbouring points, so that blocks outside a camera's view are culled.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64

from wearcap.errors import WearcapError
from wearcap.geometry import raster
from wearcap.geometry.camera import Camera
from wearcap.geometry.compiled import compiled
from wearcap.geometry.rigid import Rigid

NEAR_M = 0.02
"""Nothing closer to the camera than this (m) is drawn."""


@dataclass(frozen=True, eq=False)
class SplatCloud:
    """Points (m) in blocks of neighbours. Build it with `SplatCloud.build`."""

    points: Float32[np.ndarray, "point 3"]
    """Ordered by block."""
    order: Int32[np.ndarray, "point"]
    """Index of each of `points` in the original cloud."""
    first: Int64[np.ndarray, "edge"]
    """Block b holds points first[b] … first[b + 1] - 1."""
    centers: Float64[np.ndarray, "block 3"]
    radii: Float64[np.ndarray, "block"]

    @classmethod
    def build(cls, points: Float32[np.ndarray, "point 3"], block: int = 512) -> "SplatCloud":
        """Sort a cloud along a space-filling curve and cut it. Raises WearcapError when it is empty or not finite."""
        if not len(points) or not np.isfinite(points).all():
            raise WearcapError(
                "a cloud without points" if not len(points) else "points that are NaN or infinite",
                expected="at least one point, all finite (m)",
            )
        low = points.min(0)
        cell = max(float((points.max(0) - low).max()) / (1 << 20), 1e-9)
        order = np.argsort(_curve(points, low, cell)).astype(np.int32)
        points = points[order]
        first = np.append(np.arange(0, len(points), block), len(points)).astype(np.int64)
        start = first[:-1]
        lowest, highest = np.minimum.reduceat(points, start), np.maximum.reduceat(points, start)
        centers = 0.5 * (lowest.astype(np.float64) + highest)
        return cls(points, order, first, centers, 0.5 * np.linalg.norm(highest.astype(np.float64) - lowest, axis=1))

    def draw(
        self, camera: Camera, T_world_cam: Rigid, radius_m: float
    ) -> tuple[Int32[np.ndarray, "height width"], Float32[np.ndarray, "height width"]]:
        """Index (in the original cloud) and depth (m) of the point visible in each pixel; -1 and infinity where none
        is.

        Depth is the point's own, along the optical axis, for fisheyes along the ray.
        """
        nearness = np.full((camera.height, camera.width), -np.inf, np.float32)
        index = np.full((camera.height, camera.width), -1, np.int32)
        pose = camera_from_world(T_world_cam)
        raster.draw_splats(
            self.points,
            self.first,
            self.centers,
            self.radii + radius_m,
            pose,
            view_planes(camera),
            lens_numbers(camera),
            radius_m,
            True,
            0,
            nearness,
            index,
        )
        depth = point_depths(self.points, index, pose, camera.is_fisheye)
        seen = index >= 0
        index[seen] = self.order[index[seen]]
        return index, depth


def point_depths(
    points: Float32[np.ndarray, "point 3"],
    index: Int32[np.ndarray, "height width"],
    pose: Float64[np.ndarray, "3 4"],
    along_ray: bool,
) -> Float32[np.ndarray, "height width"]:
    """Depth (m) of the point named in each pixel, infinite where `index` is negative; `pose`: [R_cam_world | t_cam_world]."""
    seen = index >= 0
    points_cam = points[index[seen]] @ pose[:, :3].T + pose[:, 3]
    depth = np.full(index.shape, np.inf, np.float32)
    depth[seen] = np.linalg.norm(points_cam, axis=1) if along_ray else points_cam[:, 2]
    return depth


def camera_from_world(T_world_cam: Rigid) -> Float64[np.ndarray, "3 4"]:
    """[R_cam_world | t_cam_world] in double precision."""
    T_cam_world = T_world_cam.to(torch.float64).inverse()
    return np.concatenate([T_cam_world.R.cpu().numpy(), T_cam_world.t.cpu().numpy()[:, None]], 1)


@lru_cache(maxsize=64)
def lens_numbers(camera: Camera) -> Float64[np.ndarray, "number"]:
    """A camera for the compiled projection.

    0: draws angles; 1-4: fx fy cx cy; 5: nearest distance; 6: where the lens folds; 7: coefficients of the radial
    polynomial, 8: whether of the radius (else of its square); 9: whether the tangential term sees the undistorted
    point; 10-11: tangential; 12-15: thin prism; 16-18: affine (e d c); from 19 on: the coefficients.
    """
    d = camera.distortion
    radial, tangential, prism, affine = d, (0.0, 0.0), (0.0,) * 4, (0.0, 0.0, 1.0)
    if camera.model == "opencv":
        radial, tangential = (*d[:2], *d[4:]), (d[3], d[2])
    elif camera.model == "fisheye624":
        radial, tangential, prism = d[:6], (d[6], d[7]), d[8:]
    elif camera.model == "ocam":
        radial, affine = d[3:], (d[2], d[1], d[0])
    head = (
        float(camera.is_fisheye),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        NEAR_M,
        camera._fold,
        float(len(radial)),
        float(camera.model == "ocam"),
        float(camera.model == "opencv"),
    )
    return np.array([*head, *tangential, *prism, *affine, *radial], np.float64)


@lru_cache(maxsize=64)
def view_planes(camera: Camera) -> Float64[np.ndarray, "plane 3"]:
    """Inward normals of planes through the camera's centre that have its whole picture on their inner side.

    None for cameras that see more than a half-space: their pictures have no such planes.
    """
    x, y = (np.linspace(-0.5, size - 0.5, 33) for size in (camera.width, camera.height))
    border = np.concatenate(
        [np.stack([side, np.full(33, edge)], -1) for side, edge in ((x, y[0]), (x, y[-1]))]
        + [np.stack([np.full(33, edge), side], -1) for side, edge in ((y, x[0]), (y, x[-1]))]
    )
    rays = camera.unproject(torch.from_numpy(border)).numpy()
    if not np.isfinite(rays).all() or rays[:, 2].min() < 0.05:
        return np.zeros((0, 3))
    slopes = rays[:, :2] / rays[:, 2:]
    spare = 0.02 * np.ptp(slopes, axis=0)  # a bent border bulges between the sampled pixels
    low, high = slopes.min(0) - spare, slopes.max(0) + spare
    planes = np.array([[1, 0, -low[0]], [-1, 0, high[0]], [0, 1, -low[1]], [0, -1, high[1]]])
    return planes / np.linalg.norm(planes, axis=1, keepdims=True)


@compiled
def _spread(value):
    """The low 20 bits of a number with two empty bits after each."""
    value &= 0xFFFFF
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249


@compiled
def _curve(points, low, cell):
    """Position of each point along a Z-order curve."""
    code = np.empty(len(points), np.int64)
    for number in range(len(points)):
        total = np.int64(0)
        for axis in range(3):
            place = np.int64((points[number, axis] - low[axis]) / cell)
            total |= _spread(min(place, np.int64(0xFFFFF))) << axis
        code[number] = total
    return code
