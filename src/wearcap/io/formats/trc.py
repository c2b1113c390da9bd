"""Marker files: TRC (Motion Analysis, OpenSim), and what a trial of markers is for all readers."""

from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO, DETECTED, UNITS_M, Conventions
from wearcap.io.formats.poses import check_rising

_CYCLES = {"x": [1, 2, 0], "y": [2, 0, 1], "z": [0, 1, 2], AUTO: [2, 0, 1]}
"""The file's axes that become x, y and z, by the one that is up."""
_EXPECTED = "a TRC file: names in line 4, frames from line 6, each a number, a time and three coordinates per marker"
_MOST = 1000


@dataclass(frozen=True)
class Markers:
    """Places of named markers over time (m, z up); NaN where a marker was not seen."""

    timestamps: Float64[Tensor, "time"]
    names: tuple[str, ...]
    t_world_marker: Float64[Tensor, "time marker 3"]


def read_trc(path: str | Path, conventions: Conventions = DETECTED) -> Markers:
    """Markers of a .trc file (also .gz, .xz), in the unit that it states; y is up, as tools write it, unless stated.

    Markers with empty fields, or exactly in the origin, were not seen. Raises WearcapError naming the first line that is
    not as documented.
    """
    conventions.only("unit", "up", where=path)
    names, unit_m, values = list[str](), conventions.unit_m, array("d")
    for number, line in numbered_lines(path, "table"):
        fields = [field.strip() for field in line.split("\t")]
        if number == 3:
            unit_m = unit_m or next((UNITS_M[field] for field in fields if field in UNITS_M), None)
        elif number == 4:
            names = [field for field in fields[2:] if field]
        elif number > 5 and any(fields):
            fields = (fields[1:] + [""] * (1 + 3 * len(names)))[: 1 + 3 * len(names)]
            values.extend(finite_floats([field or "0" for field in fields], at_line(path, number)))
    if not (values and 0 < len(set(names)) == len(names) <= _MOST):
        raise WearcapError(f"{len(names)} names of markers and {len(values)} numbers", path, _EXPECTED)
    if unit_m is None or conventions.up not in _CYCLES:
        raise WearcapError("no unit, or an axis up of another sign", path, f"up=x, y or z, unit={'|'.join(UNITS_M)}")
    rows = np.asarray(values).reshape(-1, 1 + 3 * len(names))
    check_rising(rows[:, 0], path)
    points = unit_m * rows[:, 1:].reshape(len(rows), -1, 3)[..., _CYCLES[conventions.up]]
    points[(points == 0).all(-1)] = np.nan
    return Markers(torch.from_numpy(rows[:, 0].copy()), tuple(names), torch.from_numpy(points))
