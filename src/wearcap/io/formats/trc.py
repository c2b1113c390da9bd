"""Marker files: TRC (Motion Analysis, OpenSim), and what a marker trial is for all readers of markers."""

from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.boundary.limits import LIMITS
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO, DETECTED, UNITS_M, Conventions
from wearcap.io.formats.poses import check_rising

_R_WORLD_FILE = {
    "x": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
    "y": [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
    "z": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
}
_HEADER = 5
"""Lines before the first frame."""
_EXPECTED = "a TRC file: five lines of header, then rows of frame number, time and three coordinates per marker"


@dataclass(frozen=True)
class Markers:
    """Places of named markers over time (m, z up); NaN where a marker was not seen."""

    timestamps: Float64[Tensor, "time"]
    names: tuple[str, ...]
    t_world_marker: Float[Tensor, "time marker 3"]


def read_trc(path: str | Path, conventions: Conventions = DETECTED) -> Markers:
    """Markers of a .trc file (also .gz, .xz). The unit is the file's; the axis up is y, as TRC files have it, unless stated.

    Empty fields, and markers that lie exactly in the origin, were not seen. Raises WearcapError naming the first line that
    is not as documented.
    """
    conventions.only("unit", "up", where=path)
    names: list[str] = []
    unit, values = AUTO, array("d")
    for number, line in numbered_lines(path, "table"):
        fields, where = [field.strip() for field in line.rstrip("\r\n").split("\t")], at_line(path, number)
        if number == 3:
            unit = next((field for field in fields if field in UNITS_M), AUTO)
        elif number == 4:
            names = [field for field in fields[2:] if field]
        elif number > _HEADER and any(fields):
            row = fields[: 2 + 3 * len(names)] + [""] * (2 + 3 * len(names) - len(fields))
            seen = finite_floats([field or "0" for field in row[1:]], where)
            values.extend(seen)
    if not names or len(names) > LIMITS["bvh"].items or len(set(names)) < len(names) or not values:
        raise WearcapError(f"{len(names)} markers' names and {len(values)} numbers", path, _EXPECTED)
    unit_m = conventions.unit_m or UNITS_M.get(unit)
    if unit_m is None:
        raise WearcapError("no unit of length", at_line(path, 3), ", ".join(UNITS_M), "State it: unit=mm.")
    rows = np.asarray(values).reshape(-1, 1 + 3 * len(names))
    check_rising(rows[:, 0], path)
    points = unit_m * rows[:, 1:].reshape(len(rows), -1, 3)
    points[(points == 0).all(-1)] = np.nan
    up = "y" if conventions.up == AUTO else conventions.up
    if up not in _R_WORLD_FILE:
        raise WearcapError(f"up={up}", path, f"one of {', '.join(_R_WORLD_FILE)}")
    R = torch.tensor(_R_WORLD_FILE[up], dtype=torch.float64)
    return Markers(torch.from_numpy(rows[:, 0].copy()), tuple(names), torch.from_numpy(points) @ R.T)
