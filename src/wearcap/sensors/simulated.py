"""Simulated output of a head-mounted device's SLAM, and the noise that all simulated sensors share."""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
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


DRIFT_S = 0.5
"""Deviation (s) of the kernel that smooths a SLAM system's drift."""


@dataclass(frozen=True)
class SlamNoise:
    """Errors of a head-mounted SLAM system; zeros make it perfect."""

    jitter_m: float = 0.0015
    jitter_deg: float = 0.12
    jitter_period_s: float = 0.4
    drift_share: float = 0.0
    """Standard deviation of the position error after travelling one metre, as a share (0 with loop closure)."""
    yaw_drift_deg_per_sqrt_min: float = 0.0
    wander_m: float = 0.0
    """Root mean square of a position error that varies over `wander_period_s`."""
    wander_deg: float = 0.0
    """Root mean square angle of an orientation error that varies likewise."""
    wander_period_s: float = 4.0
    lean_deg: float = 0.0
    """Root mean square angle by which the world's vertical is off, constant in a recording."""
    scale: float = 0.0
    """Deviation of the world's scale, constant in a recording."""


def head_stream(
    motion: Motion,
    t_head_device: Float[Tensor, "3"],
    noise: SlamNoise | None = None,
    rng: np.random.Generator | None = None,
) -> HeadStream:
    """Poses of a device fixed to the head joint at `t_head_device` (m), its axes parallel to the head's.

    Without `noise` exact; with it, `rng` draws jitter and drift.
    """
    T_world_device = motion.joint("head") @ Rigid(torch.eye(3), t_head_device)
    if noise is not None:
        assert rng is not None, "noise needs a generator"
        T_world_device, _ = slam_poses(T_world_device, motion.fps, noise, rng)
    return HeadStream(motion.timestamps, T_world_device.R, T_world_device.t, torch.eye(3), t_head_device)


def slam_poses(T_world_device: Rigid, fps: float, noise: SlamNoise, rng: np.random.Generator) -> tuple[Rigid, float]:
    """A device's path as SLAM tracks it, in a world that begins at the true one; and that world's scale."""
    R, t = T_world_device.R, T_world_device.t
    jitter = smooth_noise(rng, len(t), 6, noise.jitter_period_s, fps)
    R = R @ rotation.exp(np.deg2rad(noise.jitter_deg) * jitter[:, :3])
    travelled = torch.cat([torch.zeros(1), t.diff(dim=0).norm(dim=-1)]).sqrt()[:, None]
    t = t + noise.jitter_m * jitter[:, 3:]
    if noise.drift_share or noise.yaw_drift_deg_per_sqrt_min:
        walk = torch.from_numpy(rng.standard_normal((len(t), 3))).float() * travelled
        turn = heading_walk(rng, len(t), noise.yaw_drift_deg_per_sqrt_min, fps)
        off = noise.drift_share * walk.cumsum(0)
        off = off + (turn @ (t + off - t[:1])[..., None])[..., 0] - (t + off - t[:1])
        # SLAM drifts smoothly: the walk's steps from frame to frame are no jitter of the device.
        off = scipy.ndimage.gaussian_filter1d(off.double().numpy(), DRIFT_S * fps, axis=0, mode="nearest")
        R, t = turn @ R, t + torch.from_numpy(off - off[:1]).float()
    if noise.wander_m or noise.wander_deg:
        wander = smooth_noise(rng, len(t), 6, noise.wander_period_s, fps) / np.sqrt(3)
        R, t = rotation.exp(np.deg2rad(noise.wander_deg) * wander[:, :3]) @ R, t + noise.wander_m * wander[:, 3:]
    scale = 1.0
    if noise.lean_deg or noise.scale:
        lean, stretch = rng.standard_normal(2) / np.sqrt(2), rng.standard_normal()
        world = rotation.exp(torch.tensor([*np.deg2rad(noise.lean_deg) * lean, 0.0]).float())
        scale = 1 + noise.scale * float(stretch)
        R, t = world @ R, t[:1] + scale * (t - t[:1]) @ world.mT
    return Rigid(R, t), scale
