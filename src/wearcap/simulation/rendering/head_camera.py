"""The camera on a simulated wearer's head: its mount, its clock, and the texture it sees."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import raster, rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream
from wearcap.sensors.slam import R_DEVICE_CAM
from wearcap.simulation.places.world import World

HEAD_CAMERA = Camera(
    "opencv", 1920, 1080, 871.80, 885.58, 961.54, 550.69, (-0.2546, 0.0804, 1.458e-4, -1.397e-5)
).scaled(960, 540)
"""The HPS data set's head camera at half its size."""
HEAD_CAMERA_TRUTH = "head_camera"
"""Entry of `Recording.object_motion` with the camera's true poses, on the camera's own clock."""


@dataclass(frozen=True)
class HeadCameraConfig:
    """Mount of the camera, and its clock."""

    camera_fps: float = 30.0
    clock_offset_s: float = 4.0
    """Largest offset of the camera's clock from the suit's, in either direction."""
    clock_drift_ms_per_h: tuple[float, float] = (87.0, 12.0)
    """Mean and deviation over recordings of the drift of the camera's clock."""
    mount_deg: float = 4.0
    mount_m: float = 0.008
    """Deviations of the camera's mount on the head from the nominal one."""

    def __post_init__(self):
        if self.camera_fps <= 0:
            raise WearcapError(f"{self.camera_fps} Hz of the camera", expected="more than 0")


def head_camera(
    motion: Motion, t_head_device: Float[Tensor, "3"], config: HeadCameraConfig, rng: np.random.Generator
) -> tuple[CameraStream, Trajectory, tuple[float, float]]:
    """The stream with its nominal mount, the true poses on its clock, and that clock's offset (s) and drift (ms/h)."""
    offset = float(rng.uniform(-1, 1)) * config.clock_offset_s
    drift = float(rng.normal(*config.clock_drift_ms_per_h))
    rate = 1 + drift / 3.6e6
    turn = np.deg2rad(config.mount_deg) * rng.standard_normal(3) / np.sqrt(3)
    R_mount = rotation.exp(torch.from_numpy(turn).float()) @ R_DEVICE_CAM
    t_mount = t_head_device + torch.from_numpy(config.mount_m * rng.standard_normal(3)).float()
    T_world_head = motion.joint("head")
    T_world_cam = T_world_head @ Rigid(R_mount, t_mount)[None]
    true = Trajectory(motion.timestamps, T_world_cam.R, T_world_cam.t)
    start, stop = motion.timestamps[0].item(), motion.timestamps[-1].item()
    first = start * rate + offset + float(rng.uniform(0.0, 1 / config.camera_fps))
    count = int((stop * rate + offset - first) * config.camera_fps)
    times = first + torch.arange(count, dtype=torch.float64) / config.camera_fps
    at = resample(true, ((times - offset) / rate).clamp(start, stop))
    stream = CameraStream(times, HEAD_CAMERA, R_DEVICE_CAM, torch.tensor([0.09, 0.0, 0.09]))
    return stream, Trajectory(times, at.R_world_body, at.t_world_body), (offset, drift)


_GLANCE = Camera("pinhole", 48, 27, 22.0, 22.0, 23.5, 13.0)


def view_texture(world: World, path: Trajectory, every: int = 15) -> Float[Tensor, "time"]:
    """Texture in a camera's frames: the mean texture grade (features per m²) in view.

    Every n-th frame is looked at, those between are interpolated.
    """
    frames = np.arange(0, len(path.timestamps), every)
    grade = np.append(np.minimum(world.face_texture, 60.0), 3.0)  # the sky shows roofs and trees now and then
    seen = np.empty(len(frames))
    R, t = path.R_world_body.double().numpy(), path.t_world_body.double().numpy()
    for row, frame in enumerate(frames):
        nearness = np.full((_GLANCE.height, _GLANCE.width), -np.inf, np.float32)
        index = np.full((_GLANCE.height, _GLANCE.width), -1, np.int32)
        raster.draw_pinhole(
            (world.mesh.vertices - t[frame]) @ R[frame],
            world.mesh.faces,
            _GLANCE.fx,
            _GLANCE.fy,
            _GLANCE.cx,
            _GLANCE.cy,
            0.03,
            nearness,
            index,
        )
        seen[row] = grade[index].mean()
    return torch.from_numpy(np.interp(np.arange(len(path.timestamps)), frames, seen)).float()
