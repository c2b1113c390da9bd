"""The software renderer: triangles and splats through a z-buffer to colour, depth and index images.

Pictures, simulated cameras, visibility tests and point maps use it. Triangles are exact through a pinhole
camera; through other lenses their edges are straight between projected corners, so large ones want subdividing.
A large cloud is cut once into blocks of neighbouring points (`SplatCloud`), so that blocks outside a view are culled.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64, UInt8
from scipy import ndimage

from wearcap.errors import WearcapError
from wearcap.geometry import raster
from wearcap.geometry.camera import Camera
from wearcap.geometry.compiled import compiled
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid

NEAR_M = 0.02
"""Nothing closer to the camera than this (m) is drawn."""
_MAP_SIZES = (256, 512)
"""Texels along each side of a shadow map, of pictures up to that size and of larger ones."""
_CONTACT_FADE = 0.08


@dataclass(frozen=True, eq=False)
class Splats:
    """Points (m) drawn as unshaded discs; RGB 0…1, one or per point."""

    points: Float32[np.ndarray, "point 3"]
    color: Float32[np.ndarray, "point 3"] | Float32[np.ndarray, "3"]
    radius: float = 1.0
    """Radius in pixels, or in metres if `metric`. A disc always covers the pixel nearest to its centre."""
    metric: bool = False


@dataclass(frozen=True)
class Light:
    """One directional key light and an ambient one that differs between down-facing and up-facing sides."""

    to_light: tuple[float, float, float] = (0.35, 0.5, 1.0)
    key: float = 0.55
    ambient_below: float = 0.38
    ambient_above: float = 0.62
    shadow_center: tuple[float, float, float] | None = None
    """Shadows fall within `shadow_radius` (m) of this point; None: no shadows."""
    shadow_radius: float = 2.5


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered picture."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float32[np.ndarray, "height width"]
    """Depth along the optical axis (m), for fisheyes along the ray; infinite where nothing is visible."""
    index: Int32[np.ndarray, "height width"]
    """Index of the visible primitive: faces of all meshes in order, then points of all splats; -1 where none is."""
    face_count: int

    @property
    def point_index(self) -> Int32[np.ndarray, "height width"]:
        """Index of the splat point visible in each pixel; -1 elsewhere."""
        return np.where(self.index >= self.face_count, self.index - self.face_count, -1).astype(np.int32)


def render(
    camera: Camera,
    T_world_cam: Rigid,
    meshes: Sequence[Mesh] = (),
    splats: Sequence[Splats] = (),
    *,
    light: Light = Light(),
    background: Float32[np.ndarray, "height 3"] | tuple[float, float, float] = (1.0, 1.0, 1.0),
    supersample: int = 1,
) -> Frame:
    """Render meshes and splats for a camera at T_world_cam (no batch axes).

    `background`: RGB 0…1, one or per row. `supersample` n averages n x n samples per pixel; depth and index are
    then those of the nearest sample.
    """
    fine = camera.scaled(camera.width * supersample, camera.height * supersample)
    scene, pose = _joined(meshes), _camera_from_world(T_world_cam)
    R, t = (part.detach().double().cpu().numpy() for part in (T_world_cam.R, T_world_cam.t))
    in_cam = scene._replace(vertices=(scene.vertices - t) @ R, normals=(scene.normals @ R).astype(np.float32))
    buffers = raster.empty_buffers(fine.height, fine.width)
    if fine.model == "pinhole":
        raster.draw_pinhole(in_cam.vertices, scene.faces, fine.fx, fine.fy, fine.cx, fine.cy, NEAR_M, *buffers)
    else:
        # Points of a margin outside the image are corners of triangles that reach into it.
        width, height = fine.width, fine.height
        wide = replace(fine, width=3 * width, height=3 * height, cx=fine.cx + width, cy=fine.cy + height)
        pixels, valid = wide.project(torch.from_numpy(in_cam.vertices))
        depth = np.linalg.norm(in_cam.vertices, axis=-1) if fine.is_fisheye else in_cam.vertices[:, 2]
        drawable = valid.numpy() & (depth >= NEAR_M)
        pixels = (pixels - torch.tensor([width, height])).numpy()
        raster.draw_projected(pixels, 1 / np.where(drawable, depth, 1.0), drawable, scene.faces, *buffers)
    offset = len(scene.faces)
    for cloud in splats:
        block = cloud.points, np.array([0, len(cloud.points)]), np.zeros((1, 3)), np.full(1, np.inf)
        radius = cloud.radius * (1.0 if cloud.metric else supersample)
        raster.draw_splats(block, pose, np.zeros((0, 3)), lens_numbers(fine), radius, cloud.metric, offset, *buffers)
        offset += len(cloud.points)
    colors = [np.broadcast_to(255 * cloud.color, cloud.points.shape) for cloud in splats]
    to_light = np.asarray(light.to_light, float) / np.linalg.norm(light.to_light)
    size = (camera.height, camera.width)
    picture = np.empty((*size, 3), np.uint8), np.empty(size, np.float32), np.empty(size, np.int32)
    raster.resolve(
        *buffers,
        _pixel_rays(fine),
        supersample,
        np.concatenate([R, t[:, None]], 1),
        in_cam,
        np.concatenate([np.zeros((0, 3)), *colors]).astype(np.float32),
        np.array([*to_light, light.key, light.ambient_below, light.ambient_above]),
        _shadow_maps(scene, light, _MAP_SIZES[max(fine.width, fine.height) > 2 * _MAP_SIZES[0]]),
        np.ascontiguousarray(np.broadcast_to(255 * np.asarray(background, np.float32), (camera.height, 3))),
        *picture,
    )
    frame = Frame(*picture, len(scene.faces))
    if not splats:
        return frame
    points = np.concatenate([cloud.points for cloud in splats])
    depth = _point_depths(points, frame.point_index, pose, camera.is_fisheye)
    return replace(frame, depth=np.where(frame.index < frame.face_count, frame.depth, depth))


def _orthographic_map(
    meshes: Sequence[Mesh],
    to_viewer: tuple[float, float, float],
    center: tuple[float, float, float],
    radius: float,
    size: int,
) -> tuple[Float32[np.ndarray, "size size"], np.ndarray]:
    """Height towards a viewer at infinity of the nearest surface in a square of `size` texels, -inf where none.

    Also the map's axes (3, 4): rows right, up and towards the viewer; with a point p, `axes @ (p, 1)` is its place
    from the map's corner and its height (m).
    """
    forward = np.asarray(to_viewer, float) / np.linalg.norm(to_viewer)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    axes = np.concatenate([rotation, -(rotation @ np.asarray(center))[:, None]], 1)
    axes[:2, 3] += radius
    scene = _joined(meshes)
    seen = scene.vertices @ axes[:, :3].T + axes[:, 3]
    height, index = raster.empty_buffers(size, size)
    pixels = seen[:, :2] * (size / (2 * radius))
    raster.draw_projected(pixels, seen[:, 2], np.ones(len(seen), bool), scene.faces, height, index)
    return height, axes


def _joined(meshes: Sequence[Mesh]) -> raster.Triangles:
    """All meshes in one set of arrays."""
    first_vertex = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    tables = [np.atleast_2d(mesh.color) for mesh in meshes]
    first_row = np.cumsum([0, *map(len, tables)])
    counts = [len(mesh.faces) for mesh in meshes]

    def stack(arrays: list, width: int, dtype) -> np.ndarray:
        return np.concatenate([np.zeros((0, width)), *arrays]).astype(dtype)

    return raster.Triangles(
        stack([mesh.vertices for mesh in meshes], 3, np.float64),
        stack([mesh.faces + first for mesh, first in zip(meshes, first_vertex)], 3, np.int32),
        stack([m.vertex_normals if m.smooth else np.zeros_like(m.vertices) for m in meshes], 3, np.float32),
        np.repeat(np.array([mesh.smooth for mesh in meshes], bool), counts),
        np.repeat(np.array([mesh.casts_shadow for mesh in meshes], bool), counts),
        stack([255 * table for table in tables], 3, np.float32),
        stack([mesh.color_rows + first for mesh, first in zip(meshes, first_row)], 3, np.int32),
    )


@lru_cache(maxsize=4)
def _pixel_rays(camera: Camera) -> np.ndarray:
    """Ray of every pixel, scaled so that depth times ray is the point."""
    x, y = np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32)
    if camera.model == "pinhole":
        rays = np.ones((camera.height, camera.width, 3), np.float32)
        rays[..., 0], rays[..., 1] = (x - camera.cx) / camera.fx, ((y - camera.cy) / camera.fy)[:, None]
        return rays
    grid = torch.stack(torch.meshgrid(torch.from_numpy(x), torch.from_numpy(y), indexing="xy"), -1)
    rays = camera.unproject(grid).nan_to_num(0.0)
    return (rays if camera.is_fisheye else rays / rays[..., 2:].clamp(min=1e-6)).numpy()


def _shadow_maps(scene: raster.Triangles, light: Light, size: int) -> raster.Shadows:
    """Height maps of the faces that cast shadows; empty ones without shadows."""
    if light.shadow_center is None or not scene.casts.any():
        return raster.Shadows()
    casters = [Mesh(scene.vertices.astype(np.float32), scene.faces[scene.casts], np.ones(3, np.float32))]
    where = (light.shadow_center, light.shadow_radius, size)
    nearest, key_axes = _orthographic_map(casters, light.to_light, *where)
    nearest = np.maximum(nearest, np.float32(-1e6))
    below, down_axes = _orthographic_map(casters, (0.0, 0.0, -1.0), *where)
    return raster.Shadows(
        np.concatenate([key_axes, down_axes]),
        size / (2 * light.shadow_radius),
        nearest,
        ndimage.maximum_filter(nearest, size=4, origin=-1),
        ndimage.minimum_filter(nearest, size=4, origin=-1),
        ndimage.gaussian_filter(np.exp(np.clip(below / _CONTACT_FADE, -80, 80)), sigma=2.5 * size / _MAP_SIZES[-1]),
        _CONTACT_FADE,
    )


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
            what = "a cloud without points" if not len(points) else "points that are NaN or infinite"
            raise WearcapError(what, expected="at least one point, all finite (m)")
        low = points.min(0)
        cell = max(float((points.max(0) - low).max()) / (1 << 20), 1e-9)
        order = np.argsort(_z_order(points, low, cell)).astype(np.int32)
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
        nearness, index = raster.empty_buffers(camera.height, camera.width)
        pose = _camera_from_world(T_world_cam)
        blocks = self.points, self.first, self.centers, self.radii + radius_m
        lens, planes = lens_numbers(camera), _view_planes(camera)
        raster.draw_splats(blocks, pose, planes, lens, radius_m, True, 0, nearness, index)
        depth = _point_depths(self.points, index, pose, camera.is_fisheye)
        seen = index >= 0
        index[seen] = self.order[index[seen]]
        return index, depth


def _point_depths(
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


def _camera_from_world(T_world_cam: Rigid) -> Float64[np.ndarray, "3 4"]:
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
    terms = camera.lens_terms
    flags = (len(terms.radial), camera.model == "ocam", camera.model == "opencv")
    head = (camera.is_fisheye, camera.fx, camera.fy, camera.cx, camera.cy, NEAR_M, terms.fold, *flags)
    return np.array([*head, *terms.tangential, *terms.prism, *terms.affine, *terms.radial], np.float64)


@lru_cache(maxsize=64)
def _view_planes(camera: Camera) -> Float64[np.ndarray, "plane 3"]:
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
def _z_order(points, low, cell):
    """Position of each point along a Z-order curve: the bits of its cell's coordinates, 20 each, interleaved."""
    code = np.empty(len(points), np.int64)
    for number in range(len(points)):
        total = np.int64(0)
        for axis in range(3):
            value = min(np.int64((points[number, axis] - low[axis]) / cell), np.int64(0xFFFFF))
            value &= 0xFFFFF
            # Two empty bits after each bit.
            value = (value | value << 32) & 0x1F00000000FFFF
            value = (value | value << 16) & 0x1F0000FF0000FF
            value = (value | value << 8) & 0x100F00F00F00F00F
            value = (value | value << 4) & 0x10C30C30C30C30C3
            total |= ((value | value << 2) & 0x1249249249249249) << axis
        code[number] = total
    return code
