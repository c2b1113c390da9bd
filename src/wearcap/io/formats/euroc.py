"""EuRoC trajectories: CSV of `#timestamp [ns], p x y z [m], q w x y z`, more columns (velocity, biases) may follow."""

import warnings
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.csv_table import open_text
from wearcap.io.formats.poses import checked_trajectory


def read_euroc(path: str | Path) -> Trajectory:
    """Trajectory in the file's own world and body axes (s, m); the scalar of the quaternion stands first.

    Raises WearcapError for fewer than 8 columns, NaN, unsorted times, quaternions far from unit norm.
    """
    try:
        with open_text(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy warns about an empty file; the WearcapError follows
            lines = (line for line in file if line.strip() and not line.startswith("#"))
            table = np.loadtxt(lines, delimiter=",", ndmin=2, usecols=range(8))
    except ValueError as error:
        raise WearcapError(
            f"not an EuRoC trajectory ({error})",
            where=path,
            expected="timestamp [ns], x, y, z, qw, qx, qy, qz in every line",
        ) from error
    if not len(table):
        raise WearcapError("no poses in the file", where=path, expected="lines of at least 8 numbers")
    return checked_trajectory(table[:, 0] * 1e-9, table[:, 1:4], table[:, 4:8], path)
