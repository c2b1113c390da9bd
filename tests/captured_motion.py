"""Simple motions as if captured in an empty hall: walking past, sitting on nothing, standing on air (z = 0 the floor)."""

from dataclasses import replace

import numpy as np
import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry.rotation import about_axis
from wearcap.recording import Motion

FPS = 60.0
STANDING_M = xsens23().root_height


def motion_of(root: np.ndarray, bend: np.ndarray | float = 0.0) -> Motion:
    """A body with hanging arms that follows a path ("time 3", m), hips and knees bent by an angle (rad)."""
    skeleton, frames = xsens23(), len(root)
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    angle = torch.as_tensor(np.broadcast_to(bend, frames).copy(), dtype=torch.float32)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        R[:, skeleton.index(f"{side}_shoulder")] = about_axis("x", torch.tensor(-1.4 * sign))
        R[:, skeleton.index(f"{side}_hip")] = about_axis("y", -angle)
        R[:, skeleton.index(f"{side}_knee")] = about_axis("y", angle)
    times = torch.arange(frames, dtype=torch.float64) / FPS
    return Motion(times, skeleton, R, torch.from_numpy(root).float())


def walk(metres: float = 4.0, speed: float = 1.2) -> Motion:
    frames = max(30, int(FPS * metres / speed))
    x = np.linspace(-metres / 2, metres / 2, frames)
    return motion_of(np.stack([x, 0.3 * np.sin(x), np.full(frames, STANDING_M)], 1))


def sit(height: float = 0.55) -> Motion:
    """Stand for a second, come down in one, sit for two with the pelvis at a height (m)."""
    share = np.clip(np.arange(240) / FPS - 1.0, 0.0, 1.0)
    share = share * share * (3 - 2 * share)
    x, z = -0.43 * share, STANDING_M + (height - STANDING_M) * share
    return motion_of(np.stack([x, 0 * x, z], 1), bend=share * np.pi / 2)


def climb(height: float = 0.3) -> Motion:
    """Stand on the floor for a second, swing up and forwards, stand up there for two."""
    angle = np.pi / 2 * np.clip(np.arange(210) / FPS / 0.5 - 2.0, 0.0, 1.0)
    x, z = 0.8 * (1 - np.cos(angle)), STANDING_M + height * np.sin(angle)
    return motion_of(np.stack([x, 0 * x, z], 1))


def squat() -> Motion:
    """Deep knees for four seconds, the mass over the feet: shanks and trunk lean forwards."""
    motion = motion_of(np.tile([0.0, 0.0, 0.45], (240, 1)), bend=np.pi / 2)
    R = motion.R_parent_joint.clone()
    turns = {"l5": 60.0, "left_knee": 120.0, "right_knee": 120.0, "left_ankle": -30.0, "right_ankle": -30.0}
    for name, degrees in turns.items():
        R[:, motion.skeleton.index(name)] = about_axis("y", torch.tensor(degrees).deg2rad())
    return replace(motion, R_parent_joint=R)


def jump() -> Motion:
    """On the spot, half a metre up."""
    at = np.arange(120) / FPS - 0.8
    z = np.clip(np.sqrt(2 * 9.81 * 0.5) * at - 9.81 / 2 * at**2, 0.0, None) * (at > 0)
    return motion_of(np.stack([0 * z, 0 * z, STANDING_M + z], 1))
