"""TUM trajectories: lines of `timestamp tx ty tz qx qy qz qw`, `#` begins a comment."""

from array import array
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.csv_table import open_text
from wearcap.io.formats.poses import checked_trajectory


def read_tum(path: str | Path) -> Trajectory:
    """Trajectory in the file's own world and body axes (s, m).

    Raises WearcapError for lines without 8 numbers, NaN, unsorted times, quaternions far from unit norm.
    """
    values = array("d")
    with open_text(path) as file:
        for number, line in enumerate(file, 1):
            row = line.split("#")[0].replace(",", " ").split()
            if row and len(row) != 8:
                raise WearcapError(
                    f"line {number} has {len(row)} fields", where=path, expected="timestamp tx ty tz qx qy qz qw"
                )
            try:
                values.extend(map(float, row))
            except ValueError as error:
                raise WearcapError(
                    f"line {number}: {error}"[:200], where=path, expected="lines of 8 numbers"
                ) from error
    if not values:
        raise WearcapError("no poses in the file", where=path, expected="lines of 8 numbers")
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
