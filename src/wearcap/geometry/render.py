"""The software renderer: triangles and splats through a z-buffer to colour, depth and index images.

Pictures, simulated cameras, visibility tests and point maps use it. Triangles are exact through a pinhole
camera; through other lenses their edges are straight between projected corners, so large ones want subdividing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Int32, UInt8
from scipy import ndimage

from wearcap.geometry import raster
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.splats import NEAR_M, camera_from_world, lens_numbers, point_depths


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
    scene = _joined(meshes)
    R = T_world_cam.R.detach().double().cpu().numpy()
    t = T_world_cam.t.detach().double().cpu().numpy()
    vertices_cam = (scene.vertices - t) @ R
    nearness = np.full((fine.height, fine.width), -np.inf, np.float32)
    index = np.full((fine.height, fine.width), -1, np.int32)
    if fine.model == "pinhole":
        raster.draw_pinhole(vertices_cam, scene.faces, fine.fx, fine.fy, fine.cx, fine.cy, NEAR_M, nearness, index)
    else:
        pixels, near, valid = _project(fine, vertices_cam)
        raster.draw_projected(pixels, near, valid, scene.faces, nearness, index)
    offset = len(scene.faces)
    for cloud in splats:
        one_block = np.array([0, len(cloud.points)]), np.zeros((1, 3)), np.full(1, np.inf)
        raster.draw_splats(
            cloud.points,
            *one_block,
            camera_from_world(T_world_cam),
            np.zeros((0, 3)),
            lens_numbers(fine),
            cloud.radius * (1.0 if cloud.metric else supersample),
            cloud.metric,
            offset,
            nearness,
            index,
        )
        offset += len(cloud.points)
    colors = _point_colors(splats)
    frame = _resolve(camera, fine, R, t, vertices_cam, scene, colors, light, background, nearness, index)
    if not splats:
        return frame
    points = np.concatenate([cloud.points for cloud in splats])
    depth = point_depths(points, frame.point_index, camera_from_world(T_world_cam), camera.is_fisheye)
    return replace(frame, depth=np.where(frame.index < frame.face_count, frame.depth, depth))


def orthographic_map(
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
    height = np.full((size, size), -np.inf, np.float32)
    index = np.full((size, size), -1, np.int32)
    pixels = seen[:, :2] * (size / (2 * radius))
    raster.draw_projected(pixels, seen[:, 2], np.ones(len(seen), bool), scene.faces, height, index)
    return height, axes


@dataclass(frozen=True, eq=False)
class _Scene:
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    smooth: np.ndarray
    casts: np.ndarray
    colors: np.ndarray
    color_rows: np.ndarray


def _joined(meshes: Sequence[Mesh]) -> _Scene:
    """All meshes in one set of arrays."""
    first_vertex = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    tables = [np.atleast_2d(mesh.color) for mesh in meshes]
    first_row = np.cumsum([0, *map(len, tables)])
    counts = [len(mesh.faces) for mesh in meshes]

    def stack(arrays: list, width: int, dtype) -> np.ndarray:
        return np.concatenate([np.zeros((0, width)), *arrays]).astype(dtype)

    return _Scene(
        stack([mesh.vertices for mesh in meshes], 3, np.float64),
        stack([mesh.faces + first for mesh, first in zip(meshes, first_vertex)], 3, np.int32),
        stack([m.vertex_normals if m.smooth else np.zeros_like(m.vertices) for m in meshes], 3, np.float32),
        np.repeat(np.array([mesh.smooth for mesh in meshes], bool), counts),
        np.repeat(np.array([mesh.casts_shadow for mesh in meshes], bool), counts),
        stack([255 * table for table in tables], 3, np.float32),
        stack([mesh.color_rows + first for mesh, first in zip(meshes, first_row)], 3, np.int32),
    )


def _point_colors(splats: Sequence[Splats]) -> np.ndarray:
    """RGB 0…255 of the points of all splats."""
    colors = [np.broadcast_to(255 * cloud.color, cloud.points.shape) for cloud in splats]
    return np.concatenate([np.zeros((0, 3)), *colors]).astype(np.float32)


def _project(camera: Camera, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels and nearness of points, and a mask of drawable ones, including a margin outside the image."""
    wide = Camera(
        camera.model,
        3 * camera.width,
        3 * camera.height,
        camera.fx,
        camera.fy,
        camera.cx + camera.width,
        camera.cy + camera.height,
        camera.distortion,
    )
    pixels, valid = wide.project(torch.from_numpy(points_cam))
    pixels = pixels - torch.tensor([camera.width, camera.height])
    depth = np.linalg.norm(points_cam, axis=-1) if camera.is_fisheye else points_cam[:, 2]
    valid = valid.numpy() & (depth >= NEAR_M)
    return pixels.numpy(), 1 / np.where(valid, depth, 1.0), valid


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


_MAP_SIZE = 512
_CONTACT_FADE = 0.08
"""Height (m) over which a contact shade loses 63 % of its strength."""


def _shadow_maps(scene: _Scene, light: Light) -> tuple:
    """Axes of the two maps, texels per metre, the shadow map with its local extremes, and the contact map."""
    if light.shadow_center is None or not scene.casts.any():
        none = np.zeros((0, 0), np.float32)
        return np.zeros((6, 4)), 1.0, none, none, none, none
    casters = [Mesh(scene.vertices.astype(np.float32), scene.faces[scene.casts], np.ones(3, np.float32))]
    where = (light.shadow_center, light.shadow_radius, _MAP_SIZE)
    shadow, key_axes = orthographic_map(casters, light.to_light, *where)
    shadow = np.maximum(shadow, np.float32(-1e6))
    high = ndimage.maximum_filter(shadow, size=4, origin=-1)
    low = ndimage.minimum_filter(shadow, size=4, origin=-1)
    below, down_axes = orthographic_map(casters, (0.0, 0.0, -1.0), *where)
    contact = np.exp(np.clip(below / _CONTACT_FADE, -80, 80))
    contact = ndimage.gaussian_filter(contact, sigma=2.5)
    scale = _MAP_SIZE / (2 * light.shadow_radius)
    return np.concatenate([key_axes, down_axes]), scale, shadow, high, low, contact


def _resolve(camera, fine, R, t, vertices_cam, scene, point_colors, light, background, nearness, index) -> Frame:
    """Shade the z-buffer's samples at the image's own size."""
    to_light = np.asarray(light.to_light, float) / np.linalg.norm(light.to_light)
    shine = np.array([*to_light, light.key, light.ambient_below, light.ambient_above])
    axes, scale, *maps = _shadow_maps(scene, light)
    pose = np.concatenate([R, t[:, None]], 1)
    back = np.broadcast_to(255 * np.asarray(background, np.float32), (camera.height, 3))
    color = np.empty((camera.height, camera.width, 3), np.uint8)
    depth = np.empty((camera.height, camera.width), np.float32)
    number = np.empty((camera.height, camera.width), np.int32)
    raster.resolve(
        nearness,
        index,
        _pixel_rays(fine),
        fine.width // camera.width,
        pose,
        vertices_cam,
        scene.faces,
        (scene.normals @ R).astype(np.float32),
        scene.smooth,
        scene.casts,
        scene.colors,
        scene.color_rows,
        point_colors,
        shine,
        axes,
        scale,
        *maps,
        _CONTACT_FADE,
        np.ascontiguousarray(back),
        color,
        depth,
        number,
    )
    return Frame(color, depth, number, len(scene.faces))
