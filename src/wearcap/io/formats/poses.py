"""Trajectories: the checks that every reader of poses shares, TUM's text and EuRoC's CSV.

TUM: lines of `timestamp tx ty tz qx qy qz qw`, `#` begins a comment. EuRoC: CSV of `#timestamp [ns], p x y z [m],
q w x y z`, more columns (velocity, biases) may follow.
"""

from array import array
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.csv_table import load_rows, open_text

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
        what = f"row {worst + 1}: quaternion {quat_wxyz[worst].round(4).tolist()} has norm {norm[worst]:.4f}"
        raise WearcapError(what, where, "unit quaternions", "Check that the columns are the quaternion's.")
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
            what = f"row {int(bad.argmax()) + 1}: {name} is NaN or infinite ({int(bad.sum())} such rows)"
            raise WearcapError(what, where, "finite numbers")


def check_rising(timestamps: np.ndarray, where: str | Path) -> None:
    """Raise WearcapError naming the first timestamp that is not later than the one before it."""
    late = np.diff(timestamps) <= 0
    if late.any():
        row = int(late.argmax()) + 1
        what = f"row {row + 1}: timestamp {timestamps[row]:.6f} s follows {timestamps[row - 1]:.6f} s"
        raise WearcapError(what, where, "timestamps that rise", "Sort the rows by time and drop repeated ones.")


def are_rotations(R: Float[Tensor, "*batch 3 3"], within: float) -> Bool[Tensor, "*batch"]:
    """Mask of matrices that are orthogonal, `within` an element of Rᵀ R, and no reflections."""
    apart = (R.mT @ R - torch.eye(3, dtype=R.dtype)).abs().amax((-1, -2))
    return (apart <= within) & (torch.linalg.det(R) > 0)


def read_tum(path: str | Path) -> Trajectory:
    """Trajectory in the file's own world and body axes (s, m).

    Raises WearcapError for lines without 8 numbers, NaN, unsorted times, quaternions far from unit norm.
    """
    values = array("d")
    with open_text(path) as file:
        for number, line in enumerate(file, 1):
            row = line.split("#")[0].replace(",", " ").split()
            if row and len(row) != 8:
                raise WearcapError(f"line {number} has {len(row)} fields", path, "timestamp tx ty tz qx qy qz qw")
            try:
                values.extend(map(float, row))
            except ValueError as error:
                raise WearcapError(f"line {number}: {error}"[:200], path, "lines of 8 numbers") from error
    if not values:
        raise WearcapError("no poses in the file", path, "lines of 8 numbers")
    table = np.asarray(values).reshape(-1, 8)
    return checked_trajectory(table[:, 0], table[:, 1:4], table[:, [7, 4, 5, 6]], path)


def write_tum(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory atomically, timestamps to the microsecond."""
    wxyz = quat_wxyz_from_matrix(trajectory.R_world_body.double()).numpy()
    table = np.concatenate(
        [trajectory.timestamps.numpy()[:, None], trajectory.t_world_body.double().numpy(), wxyz[:, [1, 2, 3, 0]]], 1
    )
    lines = [f"{row[0]:.6f} " + " ".join(f"{value:.7f}" for value in row[1:]) for row in table]
    write_text(path, "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n")


def read_euroc(path: str | Path) -> Trajectory:
    """Trajectory in the file's own world and body axes (s, m); the scalar of the quaternion stands first.

    Raises WearcapError for fewer than 8 columns, NaN, unsorted times, quaternions far from unit norm.
    """
    with open_text(path) as file:
        lines = (line for line in file if line.strip() and not line.startswith("#"))
        expected = "timestamp [ns], x, y, z, qw, qx, qy, qz in every line"
        table = load_rows(lines, "not an EuRoC trajectory", path, expected, delimiter=",", ndmin=2, usecols=range(8))
    if not len(table):
        raise WearcapError("no poses in the file", path, "lines of at least 8 numbers")
    return checked_trajectory(table[:, 0] * 1e-9, table[:, 1:4], table[:, 4:8], path)
