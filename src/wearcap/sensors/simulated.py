"""Simulated output of a head-mounted device's SLAM and of an inertial suit (Xsens-like), and the noise of all sensors."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import scipy.stats
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.geometry import rotation
from wearcap.recording.motion import Motion
from wearcap.recording.recording import HeadStream


def smooth_noise(
    rng: np.random.Generator, length: int, features: int, period_s: float, fps: float
) -> Float[Tensor, "time feature"]:
    """Gaussian noise of unit deviation that changes over about `period_s` (0: white)."""
    sigma = period_s * fps / 4
    if sigma < 0.3:
        return torch.from_numpy(rng.standard_normal((length, features))).float()
    pad = int(4 * sigma) + 1
    white = rng.standard_normal((length + 2 * pad, features))
    smooth = scipy.ndimage.gaussian_filter1d(white, sigma, axis=0)[pad : pad + length]
    # A Gaussian kernel of width σ leaves white noise the variance 1 / (2 √π σ).
    return torch.from_numpy(smooth * np.sqrt(2 * np.sqrt(np.pi) * sigma)).float()


def heading_walk(
    rng: np.random.Generator, length: int, deg_per_sqrt_min: float, fps: float
) -> Float[Tensor, "time 3 3"]:
    """Rotations about z whose angle walks randomly from zero; its deviation after t minutes is deg_per_sqrt_min · √t."""
    steps = rng.standard_normal((length, 1)) * (np.deg2rad(deg_per_sqrt_min) / np.sqrt(60)) / np.sqrt(fps)
    steps[:1] = 0.0
    return rotation.about_axis("z", torch.from_numpy(np.cumsum(steps, 0)).float()[:, 0])


@dataclass(frozen=True)
class SlamNoise:
    """Errors of a head-mounted SLAM system; zeros make it perfect."""

    jitter_m: float = 0.0015
    jitter_deg: float = 0.12
    jitter_period_s: float = 0.4
    drift_share: float = 0.0
    """Standard deviation of the position error after travelling one metre, as a share (0 with loop closure)."""
    yaw_drift_deg_per_sqrt_min: float = 0.0


def head_stream(
    motion: Motion,
    t_head_device: Float[Tensor, "3"],
    noise: SlamNoise | None = None,
    rng: np.random.Generator | None = None,
) -> HeadStream:
    """Poses of a device fixed to the head joint at `t_head_device` (m), its axes parallel to the head's.

    Without `noise` exact; with it, `rng` draws jitter and drift.
    """
    T_world_head = motion.joint("head")
    R = T_world_head.R.contiguous()
    t: Tensor = T_world_head @ t_head_device  # pyright: ignore[reportAssignmentType]
    if noise is not None:
        assert rng is not None, "noise needs a generator"
        jitter = smooth_noise(rng, len(t), 6, noise.jitter_period_s, motion.fps)
        R = R @ rotation.exp(np.deg2rad(noise.jitter_deg) * jitter[:, :3])
        travelled = torch.cat([torch.zeros(1), t.diff(dim=0).norm(dim=-1)]).sqrt()[:, None]
        t = t + noise.jitter_m * jitter[:, 3:]
        if noise.drift_share or noise.yaw_drift_deg_per_sqrt_min:
            walk = torch.from_numpy(rng.standard_normal((len(t), 3))).float() * travelled
            t = t + noise.drift_share * walk.cumsum(0)
            turn = heading_walk(rng, len(t), noise.yaw_drift_deg_per_sqrt_min, motion.fps)
            R, t = turn @ R, t[:1] + (turn @ (t - t[:1])[..., None])[..., 0]
    return HeadStream(motion.timestamps, R, t, torch.eye(3), t_head_device)


@dataclass(frozen=True)
class SuitNoise:
    """Errors of a suit; zeros make it perfect. The path drifts by about 0.5 m over 70 m, 1 m over 380 m."""

    fixed_deg: float = 1.0
    """Calibration error of each segment's orientation, constant in a recording."""
    slow_deg: float = 1.3
    """Orientation error that varies over `slow_period_s`."""
    slow_period_s: float = 6.0
    heading_walk_deg_per_sqrt_min: float = 0.06
    scale: float = 0.0008
    """Standard deviation of the scale error of walked distances, constant in a recording."""
    step_scale: float = 0.036
    """Standard deviation of the scale error of walked distances from step to step."""
    step_period_s: float = 2.0
    height_m: float = 0.01
    contact_delay_s: tuple[float, float] = (0.010, 0.040)
    contact_wrong: tuple[float, float] = (0.02, 0.05)
    """Share of flags that are wrong besides being late, in bursts of a tenth of a second."""


def suit_motion(
    motion: Motion, contact: Bool[Tensor, "time patch"], noise: SuitNoise, rng: np.random.Generator
) -> Motion:
    """The suit's estimate of `motion`, in a world that starts at the true one and drifts.

    `contact` is the ground truth of `FOOT_PATCHES`; the reported flags become a `contact_prob` of 0 or 1.
    """
    length, joints, fps = len(motion), len(motion.skeleton), motion.fps
    fixed = torch.from_numpy(rng.standard_normal((1, joints * 3))).float()
    slow = smooth_noise(rng, length, joints * 3, noise.slow_period_s, fps)
    error = (noise.fixed_deg * fixed + noise.slow_deg * slow).unflatten(-1, (joints, 3))
    heading = heading_walk(rng, length, noise.heading_walk_deg_per_sqrt_min, fps)
    R_world_joint = heading[:, None] @ motion.T_world_joint.R @ rotation.exp(np.deg2rad(1.0) / np.sqrt(3) * error)
    # The path's steps are integrated with errors of heading and scale; the height is the true one plus noise.
    stretch = 1 + noise.scale * float(rng.standard_normal())
    stretch = stretch + noise.step_scale * smooth_noise(rng, length, 1, noise.step_period_s, fps)
    wander = noise.height_m * smooth_noise(rng, length, 1, 20.0, fps)[:, 0]
    root = motion.t_world_root
    step = root.diff(dim=0, prepend=root[:1]).double()
    path = root[0] + ((heading.double() @ step[..., None])[..., 0] * stretch).cumsum(0)
    # Contact flags are late by a delay of the recording (to a frame), and some of them wrong.
    late = round(float(rng.uniform(*noise.contact_delay_s)) * fps)
    wrong = scipy.stats.norm.isf(float(rng.uniform(*noise.contact_wrong)))
    delayed = torch.cat([contact[:1].expand(min(late, length), -1), contact[: length - late]])
    reported = delayed ^ (smooth_noise(rng, *contact.shape, 0.2, fps) > wrong)
    return replace(
        motion,
        R_parent_joint=local_rotations(motion.skeleton, R_world_joint),
        t_world_root=torch.stack([path[:, 0], path[:, 1], root[:, 2] + wander], -1).float(),
        contact_prob=reported.float(),
        object_motion=None,
        provenance={"source": "simulated suit"},
    )
