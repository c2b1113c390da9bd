"""The view of a camera on the simulated wearer's head: the surroundings, and the wearer's own arms, hands and legs.

Small images for image encoders, one ray per pixel. The motion may also be a real one in simulated surroundings.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import raster, rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.video import write_frames
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream
from wearcap.sensors.simulated import smooth_noise
from wearsim.places.builder import hue
from wearsim.places.world import World
from wearsim.rendering.texture import AMBIENT_ABOVE, AMBIENT_BELOW, KEY
from wearsim.rendering.views import NEAR_M, Lens, Scenery, View, colored, visible
from wearsim.sensors.slam import R_DEVICE_CAM

EGO_CAMERA = Camera("pinhole", 96, 72, 36.8, 36.8, 47.5, 35.5)
"""105° x 89°, as wide as Aria's colour camera."""
EGO_FPS = 30.0
PITCH_DEG, MOUNT_DEG, MOUNT_M = (10.0, 15.0), 1.5, 0.004
"""Range of the camera's downward tilt, and deviations of its mount in angle and position."""
_CHUNK = 128
"""Number of frames whose bodies are skinned at once."""
_SKIN = np.array([[0.93, 0.76, 0.66], [0.80, 0.58, 0.44], [0.56, 0.36, 0.25], [0.30, 0.19, 0.14]])
"""Skin tones from light to dark."""
_WORN = {
    "wrist": "skin",
    "elbow": "forearm",
    "shoulder": "sleeve",
    "collar": "shirt",
    "hip": "trousers",
    "knee": "shin",
    "ankle": "shoe",
    "toe": "shoe",
    "pelvis": "trousers",
}
"""Clothing of the body part that follows each joint; the shirt covers all others."""
_MOTTLE = 0.06
"""Deviation of the colour from vertex to vertex, as a share: folds and veins."""


@dataclass(frozen=True, eq=False)
class _Shot:
    """Appearance of one recording: its light, and how the camera turns light into grey levels."""

    light: Float[np.ndarray, "6"]
    """Direction to the key light, its strength, the ambient light from below and from above."""
    gain: Float32[np.ndarray, "height width 3"]
    """White balance and vignetting."""
    exposure: Float32[np.ndarray, "time"]
    noise: float
    """Deviation in grey levels."""

    @classmethod
    def drawn(cls, frames: int, rng: np.random.Generator) -> "_Shot":
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


@dataclass(frozen=True, eq=False)
class _Body:
    """A dressed body without its head and neck."""

    model: BodyModel
    faces: Int32[np.ndarray, "face 3"]
    """Faces of the body model."""
    color: Float32[np.ndarray, "vertex 3"]
    """Vertex colours, RGB 0…1."""

    @classmethod
    def dressed(cls, skeleton: Skeleton, shape: dict[str, float], rng: np.random.Generator) -> "_Body":
        """A body fitted to the skeleton's bones; the skin tone is derived from the skeleton, the clothes are drawn.

        Raises WearcapError as `anny_body` does.
        """
        whole = anny_body(skeleton, shape)
        dominant = whole.skin_joints.gather(1, whole.skin_weights.argmax(1, keepdim=True))[:, 0]
        above = [skeleton.index(name) for name in ("neck", "head")]
        kept = ~torch.isin(dominant, torch.tensor(above))
        faces = whole.faces[kept[whole.faces].all(1)]
        vertices = faces.unique()
        number = torch.zeros(len(kept), dtype=torch.int64)
        number[vertices] = torch.arange(len(vertices))
        body = replace(
            whole,
            rest_vertices=whole.rest_vertices[vertices],
            faces=number[faces],
            regions={},
            skin_joints=whole.skin_joints[vertices],
            skin_weights=whole.skin_weights[vertices],
        )
        own = np.random.default_rng(
            zlib.crc32(skeleton.t_parent_joint.numpy().tobytes())
        )  # the same for the same bones
        place = own.uniform(0, len(_SKIN) - 1)
        tone = [np.interp(place, np.arange(len(_SKIN)), _SKIN[:, channel]) for channel in range(3)]
        skin = (np.array(tone) * own.uniform(0.94, 1.06)).astype(np.float32)
        shirt, trousers, shoe = (np.array(hue(rng, (0.0, 0.75))) * rng.uniform(0.25, 1.1) for _ in range(3))
        worn = {"skin": skin, "shirt": shirt, "trousers": trousers, "shoe": shoe}
        bare = rng.uniform(size=3)
        worn["sleeve"] = skin if bare[0] < 0.1 else shirt
        worn["forearm"] = skin if bare[1] < 0.5 or bare[0] < 0.1 else shirt
        worn["shin"] = skin if bare[2] < 0.2 else trousers
        parts = [name.removeprefix("left_").removeprefix("right_") for name in skeleton.joint_names]
        table = np.stack([worn[_WORN.get(part, "shirt")] for part in parts])[dominant[vertices].numpy()]
        color = np.clip(table * (1 + _MOTTLE * rng.standard_normal((len(table), 1))), 0.02, 0.98).astype(np.float32)
        return cls(body, body.faces.numpy().astype(np.int32), color)


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
        what = f"a video of {len(times)} frames"
        raise WearcapError(what, where=motion.provenance.get("source"), expected="two or more")
    tilt = torch.tensor([0.0, np.deg2rad(rng.uniform(*PITCH_DEG)), 0.0])
    turn = tilt + np.deg2rad(MOUNT_DEG) * torch.from_numpy(rng.standard_normal(3))
    moved = t_head_device + MOUNT_M * torch.from_numpy(rng.standard_normal(3)).float()
    R_head_cam = rotation.exp(turn.float()) @ R_DEVICE_CAM
    stream = CameraStream(times, EGO_CAMERA, R_head_cam, moved, video=f"{file.parent.name}/{file.name}")
    frames = ego_frames(world, motion, shape, stream, rng)
    write_frames(file, frames, motion.fps / every)
    return stream


def ego_frames(
    world: World, motion: Motion, shape: dict[str, float], stream: CameraStream, rng: np.random.Generator
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The image at each timestamp of the stream, which must be timestamps of the motion."""
    scenery, body = Scenery.of(world), _Body.dressed(motion.skeleton, shape, rng)
    camera = EGO_CAMERA
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    plane = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], -1)
    rays = np.concatenate([plane, np.ones((*x.shape, 1))], -1).reshape(-1, 3).astype(np.float32)
    length = np.linalg.norm(rays, axis=-1)
    view = View(np.eye(3), camera.fx, camera.cx, camera.cy, camera.width, camera.height)
    # one sample per pixel
    lens = Lens(rays / length[:, None], np.arange(len(rays), dtype=np.int32), length, 1.0 / camera.fx, (view,))
    to_depth = (lens.rays * lens.reach[:, None]).reshape(camera.height, camera.width, 3)
    rows = torch.searchsorted(motion.timestamps, stream.timestamps.contiguous())
    T_head_cam = Rigid(stream.R_head_cam, stream.t_head_cam)
    shot = _Shot.drawn(len(rows), rng)
    for first in range(0, len(rows), _CHUNK):
        T_world_joint = motion.T_world_joint[rows[first : first + _CHUNK]]
        vertices = body.model.vertices(T_world_joint).numpy()
        T_world_cam = T_world_joint[:, motion.skeleton.index("head")] @ T_head_cam[None]
        for number in range(len(vertices)):
            R, t = T_world_cam.R[number].double().numpy(), T_world_cam.t[number].double().numpy()
            pose = np.concatenate([R, t[:, None]], 1)
            nearness, index = visible(scenery, R, t, view)
            own, in_cam = np.full_like(index, -1), (vertices[number] - t) @ R
            raster.draw_pinhole(in_cam, body.faces, view.focal, view.focal, view.cx, view.cy, NEAR_M, nearness, own)
            index[own >= 0] = -1
            picture, _ = colored(scenery, lens, pose, nearness.ravel(), index.ravel(), shot.light)
            picture = picture.reshape(to_depth.shape)
            # The renderer shades the body alone, each face with its own normal.
            none = np.zeros(len(body.faces), bool)
            triangles = raster.Triangles(in_cam, body.faces, body.color, none, none, 255 * body.color, body.faces)
            background = np.zeros((view.height, 3), np.float32)
            shaded = np.empty(picture.shape, np.uint8)
            images = background, shaded, np.empty(own.shape, np.float32), np.empty_like(own)
            raster.resolve(
                nearness, own, to_depth, 1, pose, triangles, body.color, shot.light, raster.Shadows(), *images
            )
            picture[own >= 0] = shaded[own >= 0]
            picture *= shot.gain * shot.exposure[first + number]
            picture += shot.noise * rng.standard_normal(picture.shape, np.float32) + 0.5
            yield np.clip(picture, 0, 255).astype(np.uint8)
