"""Hands with planted finger angles, posed by SciPy alone, and as each device lays its joints out."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from wearcap.body.hands import CHAINS, FINGER_NAMES, HAND_JOINTS, LIMITS, default_shape
from wearcap.recording import FingerStream

FIST = np.radians([(25, 30, 30, 35, 55)] + 4 * [(0, 85, 0, 100, 60)])
SPREAD = np.radians([(25, 0, 0, 5, 5), (20, 0, 0, 0, 0), (0, 0, 0, 0, 0), (-15, 0, 0, 0, 0), (-25, 0, 0, 0, 0)])
POINTING = np.radians([(20, 25, 30, 35, 50), (0, 0, 0, 0, 0)] + 3 * [(0, 80, 0, 100, 60)])
MPS = (
    *(f"{finger}_tip" for finger in FINGER_NAMES),
    *("wrist", "thumb_proximal", "thumb_distal"),
    *(f"{finger}_{bone}" for finger in FINGER_NAMES[1:] for bone in ("proximal", "intermediate", "distal")),
)


def moving(frames: int, seed: int = 0) -> np.ndarray:
    """Angles (n, 5, 5) that change smoothly within their limits, and bend rather than overstretch."""
    rng, low, high = np.random.default_rng(seed), *np.moveaxis(LIMITS.numpy(), -1, 0)
    low = np.where(np.arange(5) >= 3, 0.15 * high, 0.8 * low)
    phase, speed = rng.uniform(0, 6.28, (5, 5)), rng.uniform(0.5, 2.0, (5, 5))
    share = 0.5 + 0.5 * np.sin(np.arange(frames)[:, None, None] / 30 * speed + phase)
    return low + share * (0.95 * high - low)


def axes(finger: str) -> np.ndarray:
    """A straight finger's axes: the thumb's lies along (0.6, 0.8, 0), its back turned to its own side by 60°."""
    if finger != "thumb":
        return np.eye(3)
    y, z = np.array([0.6, 0.8, 0.0]), np.array([0.8 * np.sin(np.pi / 3), -0.6 * np.sin(np.pi / 3), 0.5])
    return np.stack([np.cross(y, z), y, z], 1)


def joints(angles: np.ndarray, side: str, scale: float = 1.0) -> np.ndarray:
    """Places (n, 25, 3) of `HAND_JOINTS` in the wrist's axes; metacarpals of fingers are left out (NaN)."""
    shape, places = default_shape(), np.full((len(angles), len(HAND_JOINTS), 3), np.nan)
    places[:, 0] = 0.0
    for k, finger in enumerate(FINGER_NAMES):
        F, (abduction, first, twist, second, third) = axes(finger), angles[:, k].T
        turn = Rotation.from_euler("ZXY", np.stack([-abduction, -first, twist], 1))
        at = np.tile(shape.knuckles[k].numpy(), (len(angles), 1))
        for joint, bend, length in zip(CHAINS[k], (None, -second, -third), shape.bones[k].numpy()):
            turn = turn if bend is None else turn * Rotation.from_euler("X", bend[:, None])
            places[:, joint] = at
            at = at + length * turn.apply([0.0, 1.0, 0.0]) @ F.T
        places[:, CHAINS[k][3]] = at
    return scale * places * (1.0 if side == "left" else np.array([1.0, -1.0, 1.0]))


def carried(places: np.ndarray, seed: int = 1) -> np.ndarray:
    """The same hands anywhere, turned anyhow."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(len(places), random_state=seed).as_matrix()
    return np.einsum("nij,nkj->nki", turns, places) + rng.normal(size=(len(places), 1, 3))


def stream(places: np.ndarray, fps: float = 60.0) -> FingerStream:
    valid = torch.ones(len(places), dtype=torch.bool)
    times = torch.arange(len(places), dtype=torch.float64) / fps
    return FingerStream(times, torch.from_numpy(places).float(), valid, valid.float())


def at(places: np.ndarray, names) -> np.ndarray:
    """The places of some joints; a palm is between wrist and middle knuckle."""
    palm = (places[:, 0] + places[:, HAND_JOINTS.index("middle_proximal")]) / 2
    return np.stack([palm if name == "palm" else places[:, HAND_JOINTS.index(name)] for name in names], 1)
