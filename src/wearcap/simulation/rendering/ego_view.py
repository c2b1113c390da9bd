"""The view of a camera on the simulated wearer's head: the surroundings, and the wearer's own arms, hands and legs.

Small images for image encoders, one ray per pixel. The motion may also be a real one in simulated surroundings.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import raster, rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.video import write_frames
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream
from wearcap.sensors.noise import smooth_noise
from wearcap.sensors.slam import R_DEVICE_CAM
from wearcap.simulation.places.world import World
from wearcap.simulation.rendering import texture_kernels, view_kernels
from wearcap.simulation.rendering.ego_body import EgoBody, ego_body
from wearcap.simulation.rendering.texture import AMBIENT_ABOVE, AMBIENT_BELOW, KEY
from wearcap.simulation.rendering.views import NEAR_M, SKY, Scenery, View, visible

EGO_CAMERA = Camera("pinhole", 96, 72, 36.8, 36.8, 47.5, 35.5)
"""105° x 89°, as wide as Aria's colour camera."""
EGO_FPS = 30.0
PITCH_DEG, MOUNT_DEG, MOUNT_M = (10.0, 15.0), 1.5, 0.004
"""Range of the camera's downward tilt, and deviations of its mount in angle and position."""
_CHUNK = 128
"""Number of frames whose bodies are skinned at once."""
_VIEW = View(np.eye(3), EGO_CAMERA.fx, EGO_CAMERA.cx, EGO_CAMERA.cy, EGO_CAMERA.width, EGO_CAMERA.height)


@dataclass(frozen=True, eq=False)
class Shot:
    """Appearance of one recording: its light, and how the camera turns light into grey levels."""

    light: Float[np.ndarray, "6"]
    """Direction to the key light, its strength, the ambient light from below and from above."""
    gain: Float32[np.ndarray, "height width 3"]
    """White balance and vignetting."""
    exposure: Float32[np.ndarray, "time"]
    noise: float
    """Deviation in grey levels."""

    @classmethod
    def drawn(cls, frames: int, rng: np.random.Generator) -> "Shot":
        turn, rise = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(35, 75))
        to_light = [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)]
        key = KEY * rng.uniform(0.6, 2.0)
        light = np.array([*to_light, key, AMBIENT_BELOW - 0.5 * (key - KEY), AMBIENT_ABOVE - 0.5 * (key - KEY)])
        x, y = np.linspace(-1, 1, EGO_CAMERA.width), np.linspace(-1, 1, EGO_CAMERA.height)[:, None]
        corner = 1 - rng.uniform(0.05, 0.2) * (x**2 + y**2)
        gain = corner[..., None] * np.exp(0.05 * rng.standard_normal(3))
        drift = smooth_noise(rng, frames, 1, 4.0, EGO_FPS)[:, 0].clamp(-2, 2).numpy()
        exposure = np.exp(0.15 * np.clip(rng.standard_normal(), -2, 2) + 0.08 * drift)
        return cls(light, gain.astype(np.float32), exposure.astype(np.float32), rng.uniform(1.0, 3.0))


def write_ego_video(
    file: Path,
    world: World,
    motion: Motion,
    shape: dict[str, float],
    t_head_device: Float[Tensor, "3"],
    rng: np.random.Generator,
) -> CameraStream:
    """Film a motion through a world as `EGO_CAMERA` on the head sees it, into an MP4 of 30 frames a second.

    The frames are every n-th of the motion's, the first its first; the stream names the video by its folder's name
    and its own ("videos/NAME.mp4"). `motion` needs an xsens23 skeleton, to whose bones the body (`shape` as in
    `anny_body`) is fitted; `t_head_device` is the camera's place in the head's frame (m), to some millimetres.
    Raises WearcapError for fewer than two frames.
    """
    every = max(1, round(motion.fps / EGO_FPS)) if len(motion) > 1 else 1
    times = motion.timestamps[::every]
    if len(times) < 2:
        raise WearcapError(
            f"a video of {len(times)} frames", where=motion.provenance.get("source"), expected="two or more"
        )
    stream = CameraStream(times, EGO_CAMERA, *_mount(t_head_device, rng), video=f"{file.parent.name}/{file.name}")
    frames = ego_frames(world, motion, shape, stream, rng)
    write_frames(file, frames, motion.fps / every)
    return stream


def ego_frames(
    world: World, motion: Motion, shape: dict[str, float], stream: CameraStream, rng: np.random.Generator
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The image at each timestamp of the stream, which must be timestamps of the motion."""
    scenery, body = Scenery.of(world), ego_body(motion.skeleton, shape, rng)
    rows = torch.searchsorted(motion.timestamps, stream.timestamps.contiguous())
    T_head_cam = Rigid(stream.R_head_cam, stream.t_head_cam)
    shot = Shot.drawn(len(rows), rng)
    for first in range(0, len(rows), _CHUNK):
        T_world_joint = motion.T_world_joint[rows[first : first + _CHUNK]]
        vertices = body.model.vertices(T_world_joint).numpy()
        T_world_cam = T_world_joint[:, motion.skeleton.index("head")] @ T_head_cam[None]
        for number in range(len(vertices)):
            light, _ = draw_view(scenery, T_world_cam[number], body, vertices[number], shot.light)
            light *= shot.gain * shot.exposure[first + number]
            light += shot.noise * rng.standard_normal(light.shape, np.float32) + 0.5
            yield np.clip(light, 0, 255).astype(np.uint8)


def draw_view(
    scenery: Scenery,
    T_world_cam: Rigid,
    body: EgoBody,
    vertices: Float32[np.ndarray, "vertex 3"],
    light: Float[np.ndarray, "6"],
) -> tuple[Float32[np.ndarray, "height width 3"], Int32[np.ndarray, "height width"]]:
    """Light (grey levels, unbounded) in the image of `EGO_CAMERA`, and the body's face in each pixel, -1 elsewhere.

    `vertices` are the body's in the world, `light` is laid out as `Shot.light`.
    """
    R, t = T_world_cam.R.double().numpy(), T_world_cam.t.double().numpy()
    pose = np.concatenate([R, t[:, None]], 1)
    nearness, index = visible(scenery, R, t, _VIEW)
    own, in_cam = np.full_like(index, -1), (vertices - t) @ R
    raster.draw_pinhole(in_cam, body.faces, _VIEW.focal, _VIEW.focal, _VIEW.cx, _VIEW.cy, NEAR_M, nearness, own)
    index[own >= 0] = -1
    picture = _surroundings(scenery, pose, nearness, index, light)
    mine = own >= 0
    picture[mine] = _lit_body(body, in_cam, pose, nearness, own, light)[mine]
    return picture, own


def _mount(t_head_device: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Rotation and position of the camera on the head."""
    tilt = torch.tensor([0.0, np.deg2rad(rng.uniform(*PITCH_DEG)), 0.0])
    turn = tilt + np.deg2rad(MOUNT_DEG) * torch.from_numpy(rng.standard_normal(3))
    moved = MOUNT_M * torch.from_numpy(rng.standard_normal(3)).float()
    return rotation.exp(turn.float()) @ R_DEVICE_CAM, t_head_device + moved


def _unit_rays() -> tuple[Float32[np.ndarray, "pixel 3"], Float32[np.ndarray, "pixel"]]:
    """Ray of every pixel in the camera's axes, and its length per metre of depth."""
    x, y = np.meshgrid(np.arange(EGO_CAMERA.width), np.arange(EGO_CAMERA.height))
    plane = np.stack([(x - EGO_CAMERA.cx) / EGO_CAMERA.fx, (y - EGO_CAMERA.cy) / EGO_CAMERA.fy], -1)
    rays = np.concatenate([plane, np.ones((*x.shape, 1))], -1).reshape(-1, 3).astype(np.float32)
    length = np.linalg.norm(rays, axis=-1)
    return rays / length[:, None], length


_RAYS, _REACH = _unit_rays()
_SLOTS = np.arange(len(_RAYS), dtype=np.int32)


def _surroundings(
    scenery: Scenery, pose: np.ndarray, nearness: np.ndarray, index: np.ndarray, light: np.ndarray
) -> Float32[np.ndarray, "height width 3"]:
    count = len(_RAYS)
    out, points = np.zeros((count, 3), np.float32), np.empty((count, 3))
    face, facing, footprint, distance = np.empty(count, np.int32), *np.empty((3, count), np.float32)
    paint = scenery.paint
    view_kernels.meet_faces(
        _RAYS,
        _SLOTS,
        _REACH,
        1.0 / EGO_CAMERA.fx,
        pose,
        index.ravel(),
        nearness.ravel(),
        paint.frames,
        SKY,
        points,
        face,
        facing,
        footprint,
        distance,
        out,
    )
    texture_kernels.color_points(
        points,
        face,
        facing,
        footprint,
        paint.frames,
        paint.extents,
        paint.colors,
        paint.materials,
        paint.seeds,
        light,
        out,
    )
    return out.reshape(EGO_CAMERA.height, EGO_CAMERA.width, 3)


def _lit_body(
    body: EgoBody, in_cam: np.ndarray, pose: np.ndarray, nearness: np.ndarray, own: np.ndarray, light: np.ndarray
) -> UInt8[np.ndarray, "height width 3"]:
    """Image of the body alone, each face with its own normal, by the renderer's shading."""
    rays = (_RAYS * _REACH[:, None]).reshape(EGO_CAMERA.height, EGO_CAMERA.width, 3)
    none = np.zeros(len(body.faces), bool)
    triangles = raster.Triangles(in_cam, body.faces, body.color, none, none, 255 * body.color, body.faces)
    out = np.empty((EGO_CAMERA.height, EGO_CAMERA.width, 3), np.uint8)
    background = np.zeros((EGO_CAMERA.height, 3), np.float32)
    picture = out, np.empty(own.shape, np.float32), np.empty_like(own)
    raster.resolve(nearness, own, rays, 1, pose, triangles, body.color, light, raster.Shadows(), background, *picture)
    return out
