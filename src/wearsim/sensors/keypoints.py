"""Simulated detections of the wearer's own joints by a head camera, from a true motion.

Only the image borders limit visibility; occlusion by walls, furniture and the body itself is not simulated.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import norm
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream, Cue
from wearcap.sensors.simulated import smooth_noise
from wearsim.sensors.slam import R_DEVICE_CAM

ACTION_CAMERA = Camera("pinhole", 1920, 1080, 895.2, 785.7, 959.5, 539.5)
"""Field of view of an action camera's wide lens, 94° x 69°."""
DOWN_DEG, T_HEAD_CAM = 22.5, (0.09, 0.0, 0.09)
"""Downward tilt of the camera, and its position in the head's frame (m)."""
BURST_S = 0.2
"""Typical duration (s) of a burst of missed detections."""
NEAR_M = 0.05
"""Smallest visible distance from the lens (m)."""


def action_camera(timestamps: Float64[Tensor, "time"]) -> CameraStream:
    """`ACTION_CAMERA` on a head, with images at these times."""
    down = rotation.about_axis("y", torch.tensor(DOWN_DEG).deg2rad())
    return CameraStream(timestamps, ACTION_CAMERA, down @ R_DEVICE_CAM, torch.tensor(T_HEAD_CAM))


def camera_path(motion: Motion, stream: CameraStream) -> Trajectory:
    """True poses of a camera on the head of a true motion, at those of its times that the motion covers.

    Raises WearcapError when these are fewer than two.
    """
    T_world_cam = motion.joint("head") @ Rigid(stream.R_head_cam, stream.t_head_cam)[None]
    times = stream.timestamps
    times = times[(times >= motion.timestamps[0]) & (times <= motion.timestamps[-1])]
    if len(times) < 2:
        what = f"{len(times)} pictures of the head camera during the motion"
        raise WearcapError(what, expected="two or more, on one clock")
    return resample(Trajectory(motion.timestamps, T_world_cam.R, T_world_cam.t), times)


def seen_joints(
    motion: Motion,
    T_world_cam: Trajectory,
    camera: Camera,
    joints: Sequence[str],
    noise_px: float,
    drop: float,
    rng: np.random.Generator,
) -> dict[str, Cue]:
    """Simulated 2D detections of joints in a camera's frames (OpenCV axes, within the motion's time).

    A share `drop` of the visible joints is missed, in short bursts. Half of the noise variance is correlated over about
    a second; the noise level (median `noise_px`) varies over the same time, and confidence decreases with it. Cues hold
    the frames in which their joint is detected; joints that are never detected are left out.
    """
    count, fps = len(T_world_cam), 1.0 / T_world_cam.timestamps.diff().median().item()
    cues = {}
    for joint in joints:
        t_world = interpolate(motion.timestamps, motion.joint(joint).t, T_world_cam.timestamps)
        p_cam = T_world_cam.T_world_body.inverse()[:, None] @ t_world[:, None]
        pixels, seen = camera.project(p_cam)
        seen = seen & (torch.linalg.vector_norm(p_cam, dim=-1) > NEAR_M)
        missed = smooth_noise(rng, count, 1, BURST_S, fps)[:, 0] > norm.isf(drop)
        deviation = noise_px * (0.4 * smooth_noise(rng, count, 1, 1.0, fps)).exp()
        noise = (smooth_noise(rng, count, 2, 1.0, fps) + smooth_noise(rng, count, 2, 0.0, fps)) / np.sqrt(2)
        off = pixels[:, 0] + deviation * noise
        confidence = 1 / (1 + 0.25 * (deviation[:, 0] / max(noise_px, 1e-6)) ** 2)
        found = seen[:, 0] & ~missed
        if found.any():
            cues[joint] = Cue(T_world_cam.timestamps[found], joint, off[found].float(), confidence[found])
    return cues
