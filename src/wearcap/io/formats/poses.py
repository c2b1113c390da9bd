"""The checks that every reader of poses shares, and the writer of TUM's text; `trajectory.py` reads all kinds of files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory

NORM_TOLERANCE = 0.02
"""Largest deviation of a quaternion's norm from 1: text files round, but a mixed-up column is far off."""


def row_name(row: int) -> str:
    """What a message calls a row."""
    return f"row {row + 1}"


def checked_trajectory(
    timestamps: np.ndarray,
    translation: np.ndarray,
    quat_wxyz: np.ndarray,
    where: str | Path,
    name: Callable[[int], str] = row_name,
) -> Trajectory:
    """Trajectory (float32 poses) of columns read from a file: (n,) s, (n, 3) m, (n, 4) scalar first.

    Raises WearcapError for NaN or infinite values, timestamps that do not rise, quaternions far from unit norm; `name`
    is what the message calls a row.
    """
    check_finite({"timestamp": timestamps, "translation": translation, "quaternion": quat_wxyz}, where, name)
    check_rising(timestamps, where, name)
    norm = np.linalg.norm(quat_wxyz, axis=1)
    worst = int(np.abs(norm - 1).argmax())
    if abs(norm[worst] - 1) > NORM_TOLERANCE:
        what = f"{name(worst)}: quaternion {quat_wxyz[worst].round(4).tolist()} has norm {norm[worst]:.4f}"
        raise WearcapError(what, where, "unit quaternions", "Check that the columns are the quaternion's.")
    return Trajectory(
        torch.from_numpy(np.ascontiguousarray(timestamps, dtype=np.float64)),
        matrix_from_quat_wxyz(torch.tensor(quat_wxyz)).float(),
        torch.tensor(translation, dtype=torch.float32),
    )


def check_finite(columns: dict[str, np.ndarray], where: str | Path, name: Callable[[int], str] = row_name) -> None:
    """Raise WearcapError naming the first row and column that is NaN, infinite, or beyond single precision."""
    for column, values in columns.items():
        bad = ~(np.abs(values.reshape(len(values), -1)) < np.finfo(np.float32).max).all(1)
        if bad.any():
            what = f"{name(int(bad.argmax()))}: {column} is NaN or infinite ({int(bad.sum())} such rows)"
            raise WearcapError(what, where, "finite numbers")


def check_rising(timestamps: np.ndarray, where: str | Path, name: Callable[[int], str] = row_name) -> None:
    """Raise WearcapError naming the first timestamp that is not later than the one before it."""
    late = np.diff(timestamps) <= 0
    if late.any():
        row = int(late.argmax()) + 1
        relation = "repeats" if timestamps[row] == timestamps[row - 1] else "follows"
        what = f"{name(row)}: timestamp {timestamps[row]:.6f} s {relation} {timestamps[row - 1]:.6f} s"
        what += f" ({int(late.sum())} such rows)"
        raise WearcapError(what, where, "timestamps that rise", "Sort the rows by time and drop repeated ones.")


def are_rotations(R: Float[Tensor, "*batch 3 3"], within: float) -> Bool[Tensor, "*batch"]:
    """Mask of matrices that are orthogonal, `within` an element of Rᵀ R, and no reflections."""
    apart = (R.mT @ R - torch.eye(3, dtype=R.dtype)).abs().amax((-1, -2))
    return (apart <= within) & (torch.linalg.det(R) > 0)


def write_tum(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory atomically, timestamps to the microsecond."""
    wxyz = quat_wxyz_from_matrix(trajectory.R_world_body.double()).numpy()
    table = np.concatenate(
        [trajectory.timestamps.numpy()[:, None], trajectory.t_world_body.double().numpy(), wxyz[:, [1, 2, 3, 0]]], 1
    )
    lines = [f"{row[0]:.6f} " + " ".join(f"{value:.7f}" for value in row[1:]) for row in table]
    write_text(path, "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n")
