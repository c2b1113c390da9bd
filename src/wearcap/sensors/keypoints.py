"""Simulated detections of a head camera from a true motion: the wearer's own joints, and another person's pose.

Only the image borders limit visibility; occlusion by walls, furniture and the body itself is not simulated.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.stats import norm
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream, Cue
from wearcap.recording.timing import at_times
from wearcap.sensors.simulated import smooth_noise
from wearcap.sensors.slam import R_DEVICE_CAM

ACTION_CAMERA = Camera("pinhole", 1920, 1080, 895.2, 785.7, 959.5, 539.5)
"""Field of view of an action camera's wide lens, 94° x 69°."""
DOWN_DEG, T_HEAD_CAM = 22.5, (0.09, 0.0, 0.09)
"""Downward tilt of the camera, and its position in the head's frame (m)."""
BURST_S = 0.2
"""Typical duration (s) of a burst of missed detections."""
NEAR_M = 0.05
"""Smallest visible distance from the lens (m)."""
POSE_DRIFT_S, POSE_JITTER = 2.0, 1 / 6
"""Time (s) over which the errors of an estimated pose vary, and the share of them that is new in every frame."""


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


def seen_pose(
    motion: Motion, T_world_cam: Trajectory, camera: Camera, error_deg: float, drop: float, rng: np.random.Generator
) -> tuple[Motion, Float[Tensor, "time joint"]]:
    """Simulated monocular estimate of a person's pose in a camera's frames, and the confidence of each joint's rotation.

    Confidence is 0 where the joint or one of its children is outside the image, and in a share `drop` of the frames, in
    short bursts. Local rotations are off by `error_deg` (root mean square angle): half of the variance is constant, half
    drifts, and there is a little jitter (`POSE_JITTER`). The error level varies over the same time, and confidence
    decreases with it. The root is the true one.
    """
    seen = at_times(motion, T_world_cam.timestamps)
    count, joints, fps = len(seen), len(seen.skeleton), seen.fps
    p_cam = T_world_cam.T_world_body.inverse()[:, None] @ seen.T_world_joint.t
    _, inside = camera.project(p_cam)
    outside = ~(inside & (torch.linalg.vector_norm(p_cam, dim=-1) > NEAR_M))
    parents = torch.tensor(seen.skeleton.parents[1:])
    hidden = outside.float().index_add(1, parents, outside[:, 1:].float()) > 0
    missed = smooth_noise(rng, count, 1, BURST_S, fps) > norm.isf(drop)
    level = (0.4 * smooth_noise(rng, count, 1, POSE_DRIFT_S, fps)).exp()
    fixed = torch.from_numpy(rng.standard_normal((1, 3 * joints))).float()
    drift, jitter = (smooth_noise(rng, count, 3 * joints, period, fps) for period in (POSE_DRIFT_S, 0.0))
    error = np.deg2rad(error_deg) / np.sqrt(3) * level * ((fixed + drift) / np.sqrt(2) + POSE_JITTER * jitter)
    error = error.unflatten(1, (joints, 3))
    error[:, 0] = 0
    confidence = 1 / (1 + 0.25 * level**2) if error_deg else torch.ones(count, 1)
    return replace(seen, R_parent_joint=seen.R_parent_joint @ rotation.exp(error)), confidence * ~(hidden | missed)
