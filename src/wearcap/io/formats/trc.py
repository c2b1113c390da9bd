"""Marker files: TRC (Motion Analysis, OpenSim), and what a trial of markers is for all readers."""

import math
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.io.conventions import AUTO, DETECTED, UNITS_M, Conventions
from wearcap.io.formats.poses import check_rising

R_WORLD_FILE = {
    "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
"""A file's axes in the world's, by the one that is up; with y up they are OpenSim's: x forward, z right."""
_EXPECTED = "a TRC file: names in line 4, frames from line 6, each a number, a time and three coordinates per marker"
_MOST = 1000


@dataclass(frozen=True)
class Markers:
    """Places of named markers over time (m, z up); NaN where a marker was not seen."""

    timestamps: Float64[Tensor, "time"]
    names: tuple[str, ...]
    t_world_marker: Float64[Tensor, "time marker 3"]
    left_out: str = ""
    """What else the file holds."""


def markers_of(
    path: str | Path, names: list[str], times: np.ndarray, points: np.ndarray, unit_m: float | None, up: str
) -> Markers:
    """A trial of times (s) and points (time marker 3) in a file's unit and axes; NaN, or exactly the origin, was not seen.

    Raises WearcapError naming the file for names that repeat, times that do not rise, and a unit or axis that is not known.
    """
    if not (len(times) and 0 < len(set(names)) == len(names) <= _MOST):
        raise WearcapError(
            f"{len(names)} names of markers in {len(times)} frames", path, f"1 to {_MOST}, all different"
        )
    if unit_m is None or up not in R_WORLD_FILE:
        raise WearcapError("no unit, or an axis up of another sign", path, f"up=x, y or z, unit={'|'.join(UNITS_M)}")
    check_rising(times, path)
    points[(points == 0).all(-1)] = np.nan
    return Markers(torch.from_numpy(times), tuple(names), torch.from_numpy(unit_m * points @ R_WORLD_FILE[up].T))


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
    if not values or not names:
        raise WearcapError(f"{len(names)} names of markers and {len(values)} numbers", path, _EXPECTED)
    rows = np.asarray(values).reshape(-1, 1 + 3 * len(names))
    up = "y" if conventions.up == AUTO else conventions.up
    return markers_of(path, names, rows[:, 0].copy(), rows[:, 1:].reshape(len(rows), -1, 3), unit_m, up)


def write_trc(markers: Markers, path: str | Path) -> None:
    """Write markers atomically in millimetres, y up and x forward as OpenSim has them, those not seen as empty fields."""
    frames, count = markers.t_world_marker.shape[:2]
    times = markers.timestamps.tolist()
    fps = (frames - 1) / (times[-1] - times[0]) if frames > 1 else 1.0
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{Path(path).name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{fps:.6g}\t{fps:.6g}\t{frames}\t{count}\tmm\t{fps:.6g}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join("_".join(name.split()) for name in markers.names) + "\t\t",
        "\t\t" + "\t".join(f"X{k + 1}\tY{k + 1}\tZ{k + 1}" for k in range(count)),
        "",
    ]
    mm = 1000 * markers.t_world_marker.numpy() @ R_WORLD_FILE["y"]
    for frame, (time, places) in enumerate(zip(times, mm.tolist()), 1):
        cells = ["\t\t" if math.isnan(x) else f"{x:.3f}\t{y:.3f}\t{z:.3f}" for x, y, z in places]
        lines.append("\t".join([str(frame), exact(time), *cells]))
    write_text(path, "\n".join(lines) + "\n")


def exact(number: float) -> str:
    """The shortest decimal that is this number and no other."""
    return np.format_float_positional(number, trim="0")
