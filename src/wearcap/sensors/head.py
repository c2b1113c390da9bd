"""The path of a head-mounted device, as SLAM would report it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording.motion import Motion
from wearcap.recording.recording import HeadStream
from wearcap.sensors.noise import random_walk, smooth_noise


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
    T_world_device = Rigid(T_world_head.R.contiguous(), T_world_head @ t_head_device)
    if noise is not None:
        assert rng is not None, "noise needs a generator"
        T_world_device = _disturbed(T_world_device, noise, rng, motion.fps)
    return HeadStream(motion.timestamps, T_world_device.R, T_world_device.t, torch.eye(3), t_head_device)


def _disturbed(T: Rigid, noise: SlamNoise, rng: np.random.Generator, fps: float) -> Rigid:
    length = len(T.t)
    jitter = smooth_noise(rng, length, 6, noise.jitter_period_s, fps)
    R = T.R @ rotation.exp(np.deg2rad(noise.jitter_deg) * jitter[:, :3])
    t = T.t + noise.jitter_m * jitter[:, 3:]
    if noise.drift_share or noise.yaw_drift_deg_per_sqrt_min:
        travelled = torch.cat([torch.zeros(1), T.t.diff(dim=0).norm(dim=-1)]).sqrt()[:, None]
        walk = torch.from_numpy(rng.standard_normal((length, 3))).float() * travelled
        t = t + noise.drift_share * walk.cumsum(0)
        per_sqrt_s = np.deg2rad(noise.yaw_drift_deg_per_sqrt_min) / np.sqrt(60)
        turn = rotation.about_axis("z", random_walk(rng, length, 1, per_sqrt_s, fps)[:, 0])
        R, t = turn @ R, t[:1] + (turn @ (t - t[:1])[..., None])[..., 0]
    return Rigid(R, t)
