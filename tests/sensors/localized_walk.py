"""A suit and a camera on a walk with pauses, whose errors a test plants; used by several tests."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording import Localization, Motion
from wearcap.sensors.simulated import smooth_noise

LEVEL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_head_cam of an OpenCV camera that looks where the head does."""
MOUNT = Rigid(LEVEL @ rotation.exp(torch.tensor([-0.3, 0.0, 0.0])), torch.tensor([0.09, 0.02, 0.08]))


def strolling_motion(seconds: float, seed: int = 0, fps: float = 60.0, pauses: bool = True) -> Motion:
    """Walks along a winding path at 1.2 m/s, stands still for 5 of every 20 s, and looks about all the time."""
    skeleton, frames = xsens23(), int(seconds * fps)
    rng = np.random.default_rng(seed)
    time = torch.arange(frames, dtype=torch.float64) / fps
    speed = 1.2 * ((time % 20 < 15) | (not pauses)).double()
    heading = 1.5 * smooth_noise(rng, frames, 1, 15.0, fps)[:, 0].double()
    walked = torch.stack([speed * heading.cos(), speed * heading.sin(), 0 * time], -1).cumsum(0) / fps
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    R[:, 0] = rotation.about_axis("z", heading.float())
    look = 0.35 * smooth_noise(rng, frames, 3, 3.0, fps) * torch.tensor([0.3, 0.6, 1.0])
    R[:, skeleton.index("head")] = rotation.exp(look)
    bob = 0.02 * (2 * torch.pi * 1.8 * time).sin()
    root = walked + torch.stack([0 * bob, 0 * bob, skeleton.root_height + bob], -1)
    return Motion(time, skeleton, R, root.float())


@dataclass(frozen=True)
class LocalizationNoise:
    """Errors of camera poses; zeros: none."""

    position_m: float = 0.05
    angle_deg: float = 1.5
    outlier_share: float = 0.1
    burst_s: float = 0.5
    outages_s: tuple[tuple[float, float], ...] = ()
    """Start and end."""


PERFECT = LocalizationNoise(0.0, 0.0, 0.0)


def localized(
    motion: Motion, noise: LocalizationNoise, seed: int = 0, mount: Rigid = MOUNT, fps: float = 30.0
) -> Localization:
    """Camera poses at 30 Hz. Outliers come in bursts that are metres off and turned anyhow, with confidence."""
    rng = np.random.default_rng(seed + 1000)
    head, start = motion.joint("head"), motion.timestamps[0].item()
    times = start + torch.arange(int((motion.timestamps[-1].item() - start) * fps), dtype=torch.float64) / fps
    cam = resample(Trajectory(motion.timestamps, head.R, head.t), times).T_world_body @ mount
    count = len(times)
    white = torch.from_numpy(rng.standard_normal((2, count, 3))).float()
    R = cam.R @ rotation.exp(np.deg2rad(noise.angle_deg) / 3**0.5 * white[0])
    t = cam.t + noise.position_m / 3**0.5 * white[1]
    length = max(round(noise.burst_s * fps), 1)
    wrong = torch.from_numpy(rng.uniform(size=count // length + 1) < noise.outlier_share).repeat_interleave(length)[
        :count
    ]
    places = torch.from_numpy(rng.uniform(-8, 8, (count // length + 1, 3))).float().repeat_interleave(length, 0)[:count]
    turns = torch.from_numpy(rng.standard_normal((count // length + 1, 3))).float().repeat_interleave(length, 0)[:count]
    t = torch.where(wrong[:, None], t + places, t)
    R = torch.where(wrong[:, None, None], rotation.exp(turns) @ R, R)
    confidence = torch.from_numpy(rng.uniform(0.5, 1.0, count)).float()
    confidence = torch.where(wrong, 0.6 * confidence, confidence)
    for first, last in noise.outages_s:
        confidence = torch.where((times >= first) & (times < last), 0.0, confidence)
    return Localization(times, R, torch.where(confidence[:, None] > 0, t, torch.nan), confidence)


def turned(motion: Motion, angle_rad: float, moved: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Motion:
    """The motion in another world: as a suit sees it that starts at its own origin."""
    R_suit_scene = rotation.about_axis("z", torch.tensor(float(angle_rad)))
    R = motion.R_parent_joint.clone()
    R[:, 0] = R_suit_scene @ R[:, 0]
    t = (motion.t_world_root - torch.tensor(moved)) @ R_suit_scene.mT
    return replace(motion, R_parent_joint=R, t_world_root=t)
