"""Photographs of a simulated world: visibility comes from the z-buffer, colour from the texture.

Visibility is found through pinhole views (one, or the sides of a cube for fisheyes) that are at least as fine as
the picture; each pixel's own ray then meets the plane of its face, so that lenses bend texture exactly.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.interpolate
import scipy.sparse
import scipy.sparse.csgraph
import torch
from jaxtyping import Float, Float32, UInt8

from wearcap.errors import WearcapError
from wearcap.geometry import raster
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.simulation.places.world import World
from wearcap.simulation.rendering import texture_kernels, view_kernels
from wearcap.simulation.rendering.texture import Paint

NEAR_M = 0.03
SKY = np.array([[0.80, 0.84, 0.88], [0.48, 0.63, 0.85]]) * 255.0
"""Sky colour at the horizon and overhead."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """A world prepared for photographs and scans. Make it with `Scenery.of`."""

    world: World
    paint: Paint
    vertices: Float32[np.ndarray, "vertex 3"]
    faces: np.ndarray

    @classmethod
    def of(cls, world: World) -> "Scenery":
        return cls(world, Paint.of(world), _apart(world), world.mesh.faces)


_APART_M, _APART_STEPS = 0.00015, 16
_GROUND_M2 = 0.25


def _apart(world: World) -> Float32[np.ndarray, "vertex 3"]:
    """The mesh's vertices with every solid but the ground grown by its own tiny margin (at most 2.4 mm).

    Solids that touch share planes; which one is seen would change from pixel to pixel.
    """
    vertices, faces = world.mesh.vertices.astype(np.float64), world.mesh.faces
    ends = (np.concatenate([faces[:, 0], faces[:, 0]]), np.concatenate([faces[:, 1], faces[:, 2]]))
    graph = scipy.sparse.coo_array((np.ones(len(ends[0])), ends), shape=(len(vertices),) * 2)
    count, solid = scipy.sparse.csgraph.connected_components(graph, directed=False)
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    area = np.linalg.norm(normal, axis=1) / 2
    normal /= np.maximum(2 * area, 1e-20)[:, None]
    sides /= np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-20)
    angle = np.arccos(np.clip(-(sides * np.roll(sides, 1, axis=1)).sum(-1), -1, 1))  # at each corner
    outwards = np.zeros_like(vertices)
    np.add.at(outwards, faces, (angle / (np.pi / 2))[..., None] * normal[:, None])
    level = (world.face_object < 0) & (normal[:, 2] > 0.9) & (area > _GROUND_M2 / 2)
    grown = _APART_M * (1 + np.arange(count) * 7 % _APART_STEPS)
    grown[solid[faces[level, 0]]] = 0.0
    return (vertices + grown[solid][:, None] * outwards).astype(np.float32)


@dataclass(frozen=True)
class Development:
    """Conversion of light to grey levels; the defaults make a clean image."""

    exposure: float = 1.0
    contrast: float = 1.0
    """Contrast; below 1 the image fades towards its mean: haze, glare, a fogged lens."""
    noise: float = 0.0
    """Deviation of every pixel and channel (grey levels)."""
    vignetting: float = 0.0
    """Share of the light that is lost in the corners."""


def render_view(
    scenery: Scenery,
    camera: Camera,
    T_world_cam: Rigid,
    development: Development = Development(),
    rng: np.random.Generator | None = None,
    samples: int = 1,
) -> UInt8[np.ndarray, "height width 3"]:
    """The image of a camera; several poses ("frame 3 3", "frame 3") are averaged: motion blur.

    `samples` n averages n x n rays per pixel (smooth outlines). `rng` is needed for noise alone.
    """
    poses = T_world_cam if T_world_cam.R.ndim == 3 else T_world_cam[None]
    fine = camera.scaled(samples * camera.width, samples * camera.height) if samples > 1 else camera
    light = np.zeros((fine.height, fine.width, 3), np.float32)
    for number in range(len(poses.t)):
        light += _exposed(scenery, fine, poses[number])[0]
    light /= len(poses.t)
    if samples > 1:
        light = light.reshape(camera.height, samples, camera.width, samples, 3).mean((1, 3))
    return _developed(light, development, rng)


def view_depth(scenery: Scenery, camera: Camera, T_world_cam: Rigid) -> Float32[np.ndarray, "height width"]:
    """Distance along each pixel's ray (m); infinite without a surface."""
    return _exposed(scenery, camera, T_world_cam)[1]


def _exposed(scenery: Scenery, camera: Camera, T_world_cam: Rigid) -> tuple[np.ndarray, np.ndarray]:
    lens = _lens(camera)
    R, t = (part.detach().double().cpu().numpy() for part in (T_world_cam.R, T_world_cam.t))
    buffers = [visible(scenery, R @ view.R_cam_view, t, view) for view in lens.views]
    nearness = np.concatenate([near.ravel() for near, _ in buffers])
    index = np.concatenate([face.ravel() for _, face in buffers])
    count = camera.height * camera.width
    light, points = np.zeros((count, 3), np.float32), np.empty((count, 3))
    face, facing, footprint, distance = np.empty(count, np.int32), *np.empty((3, count), np.float32)
    view_kernels.meet_faces(
        lens.rays.reshape(-1, 3),
        lens.slots.ravel(),
        lens.reach.ravel(),
        2.0 / (camera.fx + camera.fy),
        np.concatenate([R, t[:, None]], 1),
        index,
        nearness,
        scenery.paint.frames,
        SKY,
        points,
        face,
        facing,
        footprint,
        distance,
        light,
    )
    texture_kernels.color_points(points, face, facing, footprint, *scenery.paint.tables, light)
    shape = camera.height, camera.width
    return light.reshape(*shape, 3), distance.reshape(shape)


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole view into which visibility is drawn."""

    R_cam_view: np.ndarray
    focal: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class _Lens:
    rays: Float32[np.ndarray, "height width 3"]
    slots: np.ndarray
    """Index of the sample in all views one after the other; -1 where the lens shows nothing."""
    reach: Float32[np.ndarray, "height width"]
    """Distance along the ray per metre of the view's depth."""
    views: tuple[View, ...]


def visible(scenery: Scenery, R: np.ndarray, t: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Nearness (1/m) and face of every sample of a view."""
    nearness = np.full((view.height, view.width), -np.inf, np.float32)
    index = np.full((view.height, view.width), -1, np.int32)
    vertices = (scenery.vertices - t) @ R
    raster.draw_pinhole(vertices, scenery.faces, view.focal, view.focal, view.cx, view.cy, NEAR_M, nearness, index)
    return nearness, index


CUBE = (
    np.eye(3),
    np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),  # to the right
    np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),  # to the left
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),  # down
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),  # up
    np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]),  # behind
)
"""Axes of the views through the sides of a cube, as columns in the camera's axes."""


@lru_cache(maxsize=8)
def _lens(camera: Camera) -> _Lens:
    rays = _rays(camera)
    seen = np.isfinite(rays).all(-1)
    rays = np.nan_to_num(rays)
    if camera.is_fisheye:
        size = int(np.ceil(camera.fx + camera.fy))
        views = [View(R, size / 2, (size - 1) / 2, (size - 1) / 2, size, size) for R in CUBE]
        side = np.stack([rays @ view.R_cam_view[:, 2] for view in views]).argmax(0)
    else:
        views, side = [_single_view(camera, rays[seen])], np.zeros(seen.shape, int)
    slots, reach = np.full(seen.shape, -1, np.int32), np.ones(seen.shape, np.float32)
    kept, first = [], 0
    for number, view in enumerate(views):
        here = seen & (side == number)
        if not here.any():
            continue
        local = rays[here] @ view.R_cam_view
        column = np.rint(view.focal * local[:, 0] / local[:, 2] + view.cx).astype(int)
        row = np.rint(view.focal * local[:, 1] / local[:, 2] + view.cy).astype(int)
        column, row = np.clip(column, 0, view.width - 1), np.clip(row, 0, view.height - 1)
        slots[here] = first + row * view.width + column
        reach[here] = 1.0 / local[:, 2]
        first += view.width * view.height
        kept.append(view)
    return _Lens(rays.astype(np.float32), slots, reach, tuple(kept))


_EVERY_PX = 8


def _rays(camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """Unit ray of every pixel, NaN where the lens maps none.

    Where it maps all, they are quintic splines through every eighth pixel's: off by less than 1e-6.
    """
    x, y = (np.arange(-2 * _EVERY_PX, n + 2 * _EVERY_PX, _EVERY_PX) for n in (camera.width, camera.height))
    grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1)).double()
    rays = camera.unproject(grid).numpy()
    all_x, all_y = np.arange(camera.width), np.arange(camera.height)
    if np.isnan(rays).any():
        return camera.unproject(torch.from_numpy(np.stack(np.meshgrid(all_x, all_y), -1)).double()).numpy()
    splines = [scipy.interpolate.RectBivariateSpline(y, x, rays[..., k], kx=5, ky=5) for k in range(3)]
    rays = np.stack([spline(all_y, all_x) for spline in splines], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _single_view(camera: Camera, rays: np.ndarray) -> View:
    """A pinhole view that holds every ray of a lens without fisheye."""
    if not len(rays) or rays[:, 2].min() < 0.05:
        raise WearcapError("a lens that sees sidewards", expected="a fisheye model for it")
    plane = rays[:, :2] / rays[:, 2:]
    focal = max(camera.fx, camera.fy)
    low, high = plane.min(0) * focal, plane.max(0) * focal
    width, height = (int(n) + 2 for n in np.ceil(high - low))
    return View(np.eye(3), focal, -low[0] + 0.5, -low[1] + 0.5, width, height)


def _developed(
    light: Float32[np.ndarray, "height width 3"], how: Development, rng: np.random.Generator | None
) -> UInt8[np.ndarray, "height width 3"]:
    if how.contrast != 1.0:
        light = light.mean() + how.contrast * (light - light.mean())
    if how.exposure != 1.0:
        light = light * how.exposure
    if how.vignetting:
        y, x = np.linspace(-1, 1, light.shape[0])[:, None], np.linspace(-1, 1, light.shape[1])
        light = light * (1 - how.vignetting * 0.5 * (x**2 + y**2))[..., None].astype(np.float32)
    if how.noise:
        assert rng is not None, "noise needs a generator"
        light = light + how.noise * rng.standard_normal(light.shape, np.float32)
    return np.clip(light + 0.5, 0, 255).astype(np.uint8)
