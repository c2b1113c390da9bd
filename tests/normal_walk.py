"""A glide whose knees follow the normal curve of the gait cycle, for tests of what is read off walks."""

import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import POINTS, normal_knee_deg
from wearcap.recording.motion import Motion


def walk(
    bend_deg: float = 0.0, speed: float = 1.2, seconds: float = 8.0, fps: float = 60, climb: float = 0.0
) -> Motion:
    """A body that glides along x, its knees following the normal curve plus a constant bend, 1.1 s a cycle."""
    times = torch.arange(round(seconds * fps), dtype=torch.float64) / fps
    R = torch.eye(3).repeat(len(times), 23, 1, 1)
    skeleton = xsens23()
    for k, side in enumerate(("left", "right")):
        share = ((times / 1.1 + 0.5 * k) % 1.0) * (POINTS - 1)
        low = share.long().clamp(max=POINTS - 2)
        curve = normal_knee_deg().double()
        flexion = curve[low] + (share - low) * (curve[low + 1] - curve[low]) + bend_deg
        R[:, skeleton.index(f"{side}_knee")] = about_axis("y", flexion.deg2rad().float())
    t = torch.stack([speed * times, 0 * times, 0.9 + climb * times], -1).float()
    return Motion(times, skeleton, R, t)
