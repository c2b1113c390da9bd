"""Simulated output of an inertial suit (Xsens-like): pose, drifting translation, foot contacts."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.geometry import rotation
from wearcap.recording.motion import Motion
from wearcap.sensors.noise import random_walk, smooth_noise


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
    per_axis = np.deg2rad(1.0) / np.sqrt(3)
    fixed = torch.from_numpy(rng.standard_normal((1, joints * 3))).float()
    slow = smooth_noise(rng, length, joints * 3, noise.slow_period_s, fps)
    error = per_axis * (noise.fixed_deg * fixed + noise.slow_deg * slow).unflatten(-1, (joints, 3))
    per_sqrt_s = np.deg2rad(noise.heading_walk_deg_per_sqrt_min) / np.sqrt(60)
    heading = rotation.about_axis("z", random_walk(rng, length, 1, per_sqrt_s, fps)[:, 0])
    R_world_joint = heading[:, None] @ motion.T_world_joint.R @ rotation.exp(error)
    return replace(
        motion,
        R_parent_joint=local_rotations(motion.skeleton, R_world_joint),
        t_world_root=_drifted(motion.t_world_root, heading, noise, rng, fps),
        contact_prob=_reported(contact, noise, rng, fps).float(),
        object_motion=None,
        provenance={"source": "simulated suit"},
    )


def _drifted(
    t_world_root: Float[Tensor, "time 3"],
    heading: Float[Tensor, "time 3 3"],
    noise: SuitNoise,
    rng: np.random.Generator,
    fps: float,
) -> Float[Tensor, "time 3"]:
    """Integrate the path's steps with their heading and scale errors; the height keeps the true one plus noise."""
    stretch = 1 + noise.scale * float(rng.standard_normal())
    stretch = stretch + noise.step_scale * smooth_noise(rng, len(t_world_root), 1, noise.step_period_s, fps)
    wander = noise.height_m * smooth_noise(rng, len(t_world_root), 1, 20.0, fps)[:, 0]
    step = t_world_root.diff(dim=0, prepend=t_world_root[:1]).double()
    turned = (heading.double() @ step[..., None])[..., 0] * stretch
    path = t_world_root[0] + turned.cumsum(0)
    return torch.stack([path[:, 0], path[:, 1], t_world_root[:, 2] + wander], -1).float()


def _reported(
    contact: Bool[Tensor, "time patch"], noise: SuitNoise, rng: np.random.Generator, fps: float
) -> Bool[Tensor, "time patch"]:
    """Contact flags, late by a delay of the recording (to a frame), some of them wrong."""
    late = round(float(rng.uniform(*noise.contact_delay_s)) * fps)
    share = float(rng.uniform(*noise.contact_wrong))
    before = contact[:1].expand(min(late, len(contact)), -1)
    delayed = torch.cat([before, contact[: len(contact) - late]])
    burst = smooth_noise(rng, *contact.shape, 0.2, fps)
    return delayed ^ (burst > scipy.stats.norm.isf(share))
