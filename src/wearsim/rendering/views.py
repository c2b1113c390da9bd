"""Photographs of a simulated world: visibility comes from the z-buffer, colour from the texture.

Visibility is found through pinhole views (one, or the sides of a cube for fisheyes) that are at least as fine as
the picture; each pixel's own ray then meets the plane of its face, so that lenses bend texture exactly.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.interpolate
import scipy.sparse
import scipy.sparse.csgraph
import torch
from jaxtyping import Float32, Int32, UInt8

from wearcap.errors import WearcapError
from wearcap.geometry import raster
from wearcap.geometry.camera import Camera
from wearcap.geometry.compiled import compiled
from wearcap.geometry.rigid import Rigid
from wearsim.places.world import World
from wearsim.rendering.texture import LIGHT, Paint
from wearsim.rendering.texture_kernels import color_points

NEAR_M = 0.03
SKY = np.array([[0.80, 0.84, 0.88], [0.48, 0.63, 0.85]]) * 255.0
"""Sky colour at the horizon and overhead."""
_EVERY_PX = 8
_APART_M, _APART_STEPS = 0.00015, 16
"""Smallest margin by which solids are grown, and the number of margins, its multiples."""
_GROUND_M2 = 0.25


@dataclass(frozen=True, eq=False)
class Scenery:
    """A world prepared for photographs and scans. Make it with `Scenery.of`."""

    world: World
    paint: Paint
    vertices: Float32[np.ndarray, "vertex 3"]
    faces: np.ndarray

    @classmethod
    def of(cls, world: World) -> "Scenery":
        """Solids that touch share planes; which one is seen would change from pixel to pixel.

        So every solid but the ground is grown by its own tiny margin (at most 2.4 mm).
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
        vertices = (vertices + grown[solid][:, None] * outwards).astype(np.float32)
        return cls(world, Paint.of(world), vertices, faces)


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
) -> UInt8[np.ndarray, "height width 3"]:
    """The image of a camera; several poses ("frame 3 3", "frame 3") are averaged: motion blur.

    `rng` is needed for noise alone.
    """
    poses = T_world_cam if T_world_cam.R.ndim == 3 else T_world_cam[None]
    light = np.zeros((camera.height, camera.width, 3), np.float32)
    for number in range(len(poses.t)):
        light += exposed(scenery, camera, poses[number])[0]
    light /= len(poses.t)
    if development.contrast != 1.0:
        light = light.mean() + development.contrast * (light - light.mean())
    if development.exposure != 1.0:
        light = light * development.exposure
    if development.vignetting:
        y, x = np.linspace(-1, 1, light.shape[0])[:, None], np.linspace(-1, 1, light.shape[1])
        light = light * (1 - development.vignetting * 0.5 * (x**2 + y**2))[..., None].astype(np.float32)
    if development.noise:
        assert rng is not None, "noise needs a generator"
        light = light + development.noise * rng.standard_normal(light.shape, np.float32)
    return np.clip(light + 0.5, 0, 255).astype(np.uint8)


def exposed(
    scenery: Scenery, camera: Camera, T_world_cam: Rigid
) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
    """Light in the image, and distance along each pixel's ray (m; infinite without a surface)."""
    lens, shape = _lens(camera), (camera.height, camera.width)
    R, t = (part.detach().double().cpu().numpy() for part in (T_world_cam.R, T_world_cam.t))
    buffers = [visible(scenery, R @ view.R_cam_view, t, view) for view in lens.views]
    nearness, index = (np.concatenate([buffer.ravel() for buffer in pair]) for pair in zip(*buffers))
    light, distance = colored(scenery, lens, np.concatenate([R, t[:, None]], 1), nearness, index, LIGHT)
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
class Lens:
    """Rays of an image's pixels, and the samples of its pinhole views that they meet first."""

    rays: Float32[np.ndarray, "pixel 3"]
    slots: Int32[np.ndarray, "pixel"]
    """Index of the sample in all views one after the other; -1 where the lens shows nothing."""
    reach: Float32[np.ndarray, "pixel"]
    """Distance along the ray per metre of the view's depth."""
    pixel_angle: float
    """Angle between neighbouring pixels (rad)."""
    views: tuple[View, ...]


def visible(scenery: Scenery, R: np.ndarray, t: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Nearness (1/m) and face of every sample of a view; -1 without a face."""
    nearness, index = raster.empty_buffers(view.height, view.width)
    vertices = (scenery.vertices - t) @ R
    raster.draw_pinhole(vertices, scenery.faces, view.focal, view.focal, view.cx, view.cy, NEAR_M, nearness, index)
    return nearness, index


def colored(
    scenery: Scenery, lens: Lens, pose: np.ndarray, nearness: np.ndarray, index: np.ndarray, light: np.ndarray
) -> tuple[Float32[np.ndarray, "pixel 3"], Float32[np.ndarray, "pixel"]]:
    """Light in every pixel, and its distance along the ray (m; infinite without a surface).

    `pose` is [R | t] of the camera in the world, `nearness` and `index` are the (flat) samples of the lens's views, and
    `light` is laid out as `texture.LIGHT`.
    """
    count = len(lens.slots)
    out, points = np.zeros((count, 3), np.float32), np.empty((count, 3))
    face, facing, footprint, distance = np.empty(count, np.int32), *np.empty((3, count), np.float32)
    _meet_faces(
        (lens.rays, lens.slots, lens.reach, lens.pixel_angle),
        pose,
        (index, nearness),
        scenery.paint.frames,
        SKY,
        (points, face, facing, footprint, distance, out),
    )
    color_points(points, face, facing, footprint, scenery.paint.tables, light, out)
    return out, distance


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
def _lens(camera: Camera) -> Lens:
    # Unit ray of every pixel, NaN where the lens maps none. Where it maps all, they are quintic splines through every
    # eighth pixel's: off by less than 1e-6.
    x, y = (np.arange(-2 * _EVERY_PX, n + 2 * _EVERY_PX, _EVERY_PX) for n in (camera.width, camera.height))
    all_x, all_y = np.arange(camera.width), np.arange(camera.height)
    some, every = (torch.from_numpy(np.stack(np.meshgrid(*axes), -1)).double() for axes in ((x, y), (all_x, all_y)))
    rays = camera.unproject(some).numpy()
    if np.isnan(rays).any():
        rays = camera.unproject(every).numpy()
    else:
        splines = [scipy.interpolate.RectBivariateSpline(y, x, rays[..., k], kx=5, ky=5) for k in range(3)]
        rays = np.stack([spline(all_y, all_x) for spline in splines], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    seen = np.isfinite(rays).all(-1)
    rays = np.nan_to_num(rays)
    if camera.is_fisheye:
        size = int(np.ceil(camera.fx + camera.fy))
        views = [View(R, size / 2, (size - 1) / 2, (size - 1) / 2, size, size) for R in CUBE]
        side = np.stack([rays @ view.R_cam_view[:, 2] for view in views]).argmax(0)
    else:
        if not seen.any() or rays[seen][:, 2].min() < 0.05:
            raise WearcapError("a lens that sees sidewards", expected="a fisheye model for it")
        plane = rays[seen][:, :2] / rays[seen][:, 2:]
        focal = max(camera.fx, camera.fy)
        low, high = plane.min(0) * focal, plane.max(0) * focal
        width, height = (int(n) + 2 for n in np.ceil(high - low))
        views = [View(np.eye(3), focal, -low[0] + 0.5, -low[1] + 0.5, width, height)]  # it holds every ray
        side = np.zeros(seen.shape, int)
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
    flat_rays = rays.astype(np.float32).reshape(-1, 3)
    return Lens(flat_rays, slots.ravel(), reach.ravel(), 2.0 / (camera.fx + camera.fy), tuple(kept))


@compiled
def _meet_faces(lens, pose, buffers, frames, sky, out):
    """Point, face, side (1 front, -1 back), footprint (m), distance along the ray (m) and light of every pixel: `out`.

    `lens` holds the fields of `Lens` but its views, `buffers` the index and the nearness of the samples. `frames` are
    `Paint.frames`. A pixel without a face (-1) gets its colour in the light: black, or the sky's.
    """
    rays, slots, reach, pixel_angle = lens
    index, nearness = buffers
    points, face, facing, footprint, distance, light = out
    for k in range(len(slots)):
        slot = slots[k]
        face[k], distance[k] = -1, math.inf
        if slot < 0:
            continue
        u, v, w = rays[k, 0], rays[k, 1], rays[k, 2]
        dx = pose[0, 0] * u + pose[0, 1] * v + pose[0, 2] * w
        dy = pose[1, 0] * u + pose[1, 1] * v + pose[1, 2] * w
        dz = pose[2, 0] * u + pose[2, 1] * v + pose[2, 2] * w
        number = index[slot]
        if number < 0:
            rise = min(1.0, max(0.0, 0.5 + 0.8 * dz))
            for channel in range(3):
                light[k, channel] = sky[0, channel] + rise * (sky[1, channel] - sky[0, channel])
            continue
        f = frames[number]
        slope = dx * f[9] + dy * f[10] + dz * f[11]
        above = (pose[0, 3] - f[0]) * f[9] + (pose[1, 3] - f[1]) * f[10] + (pose[2, 3] - f[2]) * f[11]
        # A pixel's ray misses its face by up to a sample at outlines: it stays near the drawn depth.
        near = reach[k] / nearness[slot]
        d = (f[12] - above) / slope if abs(slope) > 1e-9 else near
        d = min(1.08 * near, max(0.92 * near, d))
        points[k, 0], points[k, 1], points[k, 2] = (pose[0, 3] + d * dx, pose[1, 3] + d * dy, pose[2, 3] + d * dz)
        face[k], distance[k], facing[k] = number, d, -1.0 if slope > 0 else 1.0
        footprint[k] = d * pixel_angle / math.sqrt(max(0.12, abs(slope)))
