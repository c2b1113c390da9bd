"""Landmarks: keypoints of several images at one place of the scene, merged to one point with one descriptor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int8, Int32

STEPS = 254.0
"""Quantisation of unit-length descriptors to bytes: round(254 d), so components beyond ±0.5 are clipped."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Scene points at which keypoints were detected."""

    points_world: Float32[np.ndarray, "landmark 3"]
    descriptors: Int8[np.ndarray, "landmark feature"]
    """Mean of the keypoints' descriptors, of unit length."""


def to_bytes(descriptors: Float32[np.ndarray, "keypoint feature"]) -> Int8[np.ndarray, "keypoint feature"]:
    """Descriptors of unit length in a quarter of the memory."""
    return np.clip(np.rint(descriptors * STEPS), -127, 127).astype(np.int8)


def from_bytes(descriptors: Int8[np.ndarray, "keypoint feature"]) -> Float32[np.ndarray, "keypoint feature"]:
    """Descriptors of unit length again."""
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def merge(
    positions: Float32[np.ndarray, "observation 3"],
    descriptors: Int8[np.ndarray, "observation feature"],
    cell_m: float,
    min_cosine: float = 0.85,
) -> tuple[Landmarks, Int32[np.ndarray, "observation"]]:
    """Landmarks, and the one that each observation belongs to.

    Observations within one cell of `cell_m` are one landmark where their descriptors are alike. With `cell_m` 0 those
    at exactly the same position are, whatever their descriptors (tracks of structure from motion).
    """
    if not len(positions):
        return Landmarks(positions, descriptors), np.zeros(0, np.int32)
    place = positions if cell_m == 0 else np.floor(positions / cell_m).astype(np.int64)
    _, cell = np.unique(place, axis=0, return_inverse=True)
    group = cell.ravel() if cell_m == 0 else _leaders(cell.ravel(), descriptors, min_cosine)
    _, landmark, count = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(landmark, kind="stable")
    start = np.cumsum(count) - count
    mean = np.add.reduceat(positions[order].astype(np.float64), start) / count[:, None]
    total = np.add.reduceat(descriptors[order].astype(np.float32), start)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-6)
    return Landmarks(mean.astype(np.float32), to_bytes(total)), landmark.astype(np.int32)


def _leaders(cell: np.ndarray, descriptors: np.ndarray, min_cosine: float, rounds: int = 12) -> np.ndarray:
    """For each observation the leader of its group: repeatedly, the first remaining one of each cell collects the
    similar ones of that cell."""
    leader = np.full(len(cell), -1)
    left = np.arange(len(cell))
    for _ in range(rounds):
        _, first = np.unique(cell[left], return_index=True)
        lead_of_cell = np.full(cell.max() + 1, -1)
        lead_of_cell[cell[left[first]]] = left[first]
        lead = lead_of_cell[cell[left]]
        alike = _cosine(descriptors, left, lead) >= min_cosine
        alike[first] = True
        leader[left[alike]] = lead[alike]
        left = left[~alike]
        if not len(left):
            return leader
    leader[left] = left
    return leader


def _cosine(descriptors: np.ndarray, a: np.ndarray, b: np.ndarray, chunk: int = 1 << 18) -> np.ndarray:
    parts = [
        np.einsum("nd,nd->n", from_bytes(descriptors[a[k : k + chunk]]), from_bytes(descriptors[b[k : k + chunk]]))
        for k in range(0, len(a), chunk)
    ]
    return np.concatenate([np.zeros(0, np.float32), *parts])
