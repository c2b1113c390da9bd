"""Poses of one device as they stand in a file."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RawPoses:
    """Poses of one device as they stand in a file."""

    seconds: np.ndarray  # (n,) s, rising
    position: np.ndarray  # (n, 3) in the file's unit and axes, float64
    rotation: np.ndarray  # (n, 4) quaternions in the file's order, or (n, 3, 3) matrices
    order: str | None  # "xyzw" or "wxyz" where the file names it; None: not known; for matrices None
    kind: str | None  # "wrist" or "grip" where names show it, else None
