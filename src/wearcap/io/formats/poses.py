"""Checks that every reader of a trajectory shares."""

from pathlib import Path

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.geometry.trajectory import Trajectory

NORM_TOLERANCE = 0.02
"""Largest deviation of a quaternion's norm from 1: text files round, but a mixed-up column is far off."""


def checked_trajectory(
    timestamps: np.ndarray, translation: np.ndarray, quat_wxyz: np.ndarray, where: str | Path
) -> Trajectory:
    """Trajectory (float32 poses) of columns read from a file: (n,) s, (n, 3) m, (n, 4) scalar first.

    Raises WearcapError for NaN or infinite values, timestamps that do not rise, quaternions far from unit norm.
    """
    check_finite({"timestamp": timestamps, "translation": translation, "quaternion": quat_wxyz}, where)
    check_rising(timestamps, where)
    norm = np.linalg.norm(quat_wxyz, axis=1)
    worst = int(np.abs(norm - 1).argmax())
    if abs(norm[worst] - 1) > NORM_TOLERANCE:
        raise WearcapError(
            f"row {worst + 1}: quaternion {quat_wxyz[worst].round(4).tolist()} has norm {norm[worst]:.4f}",
            where=where,
            expected="unit quaternions",
            fix="Check that the columns are the quaternion's.",
        )
    return Trajectory(
        torch.from_numpy(np.ascontiguousarray(timestamps, dtype=np.float64)),
        matrix_from_quat_wxyz(torch.tensor(quat_wxyz)).float(),
        torch.tensor(translation, dtype=torch.float32),
    )


def check_finite(columns: dict[str, np.ndarray], where: str | Path) -> None:
    """Raise WearcapError naming the first row and column that is NaN, infinite, or beyond single precision."""
    for name, values in columns.items():
        bad = ~(np.abs(values.reshape(len(values), -1)) < np.finfo(np.float32).max).all(1)
        if bad.any():
            raise WearcapError(
                f"row {int(bad.argmax()) + 1}: {name} is NaN or infinite ({int(bad.sum())} such rows)",
                where=where,
                expected="finite numbers",
            )


def check_rising(timestamps: np.ndarray, where: str | Path) -> None:
    """Raise WearcapError naming the first timestamp that is not later than the one before it."""
    late = np.diff(timestamps) <= 0
    if late.any():
        row = int(late.argmax()) + 1
        raise WearcapError(
            f"row {row + 1}: timestamp {timestamps[row]:.6f} s follows {timestamps[row - 1]:.6f} s",
            where=where,
            expected="timestamps that rise",
            fix="Sort the rows by time and drop repeated ones.",
        )
