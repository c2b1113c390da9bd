"""Data for benchmarks that ask how fast and not how well: bodies that swing their joints."""

import math

import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.recording import FloorTrack, HeadStream, Motion, Recording


def swinging(name: str, seconds: float, seed: int, fps: float = 60.0) -> Recording:
    """A recording with head path, motion and floor; every number is a function of the seed."""
    random = torch.Generator().manual_seed(seed)
    t = torch.arange(round(seconds * fps), dtype=torch.float64) / fps
    skeleton = xsens23()
    amplitude, frequency = (0.4 * torch.randn(23, 3, generator=random), 0.3 + torch.rand(23, 3, generator=random))
    rotvec = amplitude * torch.sin(2 * math.pi * frequency * t.float()[:, None, None])
    root = torch.stack([1.2 * t, torch.sin(t), 0.95 + 0.03 * torch.sin(12 * t)], -1).float()
    motion = Motion(t, skeleton, rotation.exp(rotvec), root)
    T_world_head = motion.joint("head")
    head = HeadStream(t, T_world_head.R.contiguous(), T_world_head.t.contiguous(), torch.eye(3), torch.zeros(3))
    return Recording(
        name, head=head, motion=motion, floor=FloorTrack(t, torch.zeros(len(t))), skeleton=skeleton, subject=name
    )
