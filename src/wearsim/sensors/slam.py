"""Simulated semi-dense SLAM points: on textured surfaces that the device saw, with triangulation noise."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh, face_normals, random_points
from wearcap.geometry.render import render
from wearcap.geometry.rigid import Rigid
from wearcap.recording.recording import HeadStream, PointCloud

CAMERA = Camera("pinhole", 160, 120, 66.0, 66.0, 79.5, 59.5)
"""Visibility camera, 100° × 85°, at a resolution that resolves occlusion by walls."""

R_DEVICE_CAM = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""OpenCV camera axes (right, down, forward) in the device's (forward, left, up)."""


@dataclass(frozen=True)
class SlamPoints:
    """Parameters of the simulated point cloud."""

    density: float = 40.0
    """Times as many points as the textures' features: semi-dense maps follow edges, not corners. Real ones of Aria have
    some 200 of the 1000 cells of a body's surroundings (`scene.voxels`) filled."""
    densest: float = 1500.0
    """Points per m² at most."""
    max_candidates: int = 200_000
    max_keyframes: int = 200
    keyframe_m: float = 0.4
    keyframe_deg: float = 25.0
    range_m: float = 10.0
    noise_at_2m: float = 0.01
    """Standard deviation of depth at 2 m (m); it grows with distance squared."""
    outliers: float = 0.03


def semidense_points(
    mesh: Mesh,
    face_texture: Float[np.ndarray, "face"],
    head: HeadStream,
    rng: np.random.Generator,
    settings: SlamPoints = SlamPoints(),
) -> PointCloud:
    """Points on `mesh` (features per m² by face, seen from the side of its normal) that the device saw, each from
    where it was seen first.

    Confidence falls with the deviation of depth: 1 at zero, 0.5 at 2 cm.
    """
    texture = np.minimum(settings.density * face_texture, settings.densest)
    points, normals = textured_points(mesh, texture, rng, settings.max_candidates)
    first = np.full(len(points), -1)
    frames = keyframes(head, settings)
    for frame in frames:
        T_world_cam = Rigid(head.R_world_device[frame] @ R_DEVICE_CAM, head.t_world_device[frame])
        unseen = np.flatnonzero(first < 0)
        # Visible: inside the image, in range, facing the camera, and not occluded
        candidates = points[unseen]
        in_cam = T_world_cam.inverse()[None] @ torch.from_numpy(candidates).float()
        pixels, valid = CAMERA.project(in_cam)
        depth = render(CAMERA, T_world_cam, [mesh]).depth
        z = np.asarray(in_cam[:, 2])
        column, row = pixels.nan_to_num(-1.0).round().long().unbind(-1)
        inside = valid.numpy() & (z > 0.2) & (z < settings.range_m)
        inside &= ((column >= 0) & (column < CAMERA.width) & (row >= 0) & (row < CAMERA.height)).numpy()
        inside &= ((np.asarray(T_world_cam.t) - candidates) * normals[unseen]).sum(1) > 0
        surface = np.full(len(candidates), -np.inf)
        surface[inside] = depth[row.numpy()[inside], column.numpy()[inside]]
        seen = inside & (z < surface * 1.03 + 0.05)
        first[unseen[seen]] = frame
    seen = first >= 0
    points, first = points[seen], first[seen]
    eyes = head.t_world_device.numpy()[first]
    ray = points - eyes
    distance = np.linalg.norm(ray, axis=1)
    deviation = settings.noise_at_2m * (distance / 2) ** 2
    relative_error = deviation * rng.standard_normal(len(points)) / np.maximum(distance, 1e-6)
    wrong = rng.random(len(points)) < settings.outliers
    relative_error[wrong] = np.exp(rng.normal(0.0, 0.5, wrong.sum())) - 1
    noisy = points + ray * relative_error[:, None]
    order = np.argsort(first, kind="stable")
    return PointCloud(
        torch.from_numpy(noisy[order]).float(),
        torch.from_numpy(1 / (1 + (deviation[order] / 0.02) ** 2)).float(),
        head.timestamps[torch.from_numpy(first[order])],
    )


def textured_points(
    mesh: Mesh, face_texture: Float[np.ndarray, "face"], rng: np.random.Generator, limit: int
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 3"]]:
    """Points on the surface, as dense as its texture, at most about `limit`; and the surface's unit normals there."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    normal = face_normals(corners)
    area = 0.5 * np.linalg.norm(normal, axis=1)
    expected = area * face_texture
    expected *= min(1.0, limit / max(expected.sum(), 1e-9))
    face = np.repeat(np.arange(len(area)), rng.poisson(expected))
    return random_points(corners[face], rng), normal[face] / (2 * area[face, None])


def keyframes(head: HeadStream, settings: SlamPoints) -> list[int]:
    """Keyframes after each `keyframe_m` or `keyframe_deg` of combined motion, thinned to the limit."""
    moved = head.t_world_device.diff(dim=0).norm(dim=-1) / settings.keyframe_m
    turned = rotation.geodesic(head.R_world_device[:-1], head.R_world_device[1:])
    effort = torch.cumsum(moved + turned / np.deg2rad(settings.keyframe_deg), 0)
    chosen = [0, *((effort.floor().diff() > 0).nonzero()[:, 0] + 2).tolist()]
    return chosen[:: max(1, -(-len(chosen) // settings.max_keyframes))]
