"""Marker files of any kind, and C3D, the format of optical laboratories (needs the extra: `pip install "wearcap[biomechanics]"`).

C3D is taken apart by the pure-Python library `c3d`, in memory: a damaged or hostile file can only raise. (A parser in C++,
ezc3d, is faster, but of 600 mutated files it crashed on 7 and did not end on one.) Sizes are checked before frames are read.
"""

import io
import math
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from wearcap.boundary.opening import read_bytes, understood
from wearcap.extras import required
from wearcap.io.conventions import AUTO, DETECTED, UNITS_M, Conventions
from wearcap.io.formats.trc import Markers, markers_of, read_trc

_DAMAGE = (
    AssertionError,
    struct.error,
    ArithmeticError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    MemoryError,
    UnboundLocalError,  # a parameter block that ends too soon, in the library
)
_BLOCK = 512


def read_markers(path: str | Path, conventions: Conventions = DETECTED) -> Markers:
    """Markers of a .c3d file, or of a .trc file (both also .gz, .xz). Raises WearcapError as their readers do."""
    return (read_c3d if ".c3d" in Path(path).name.lower() else read_trc)(path, conventions)


def read_c3d(path: str | Path, conventions: Conventions = DETECTED) -> Markers:
    """Markers of a .c3d file in the unit and with the axis up that it states (else millimetres, z), unless stated here.

    A marker was not seen where its residual is negative or a coordinate is no number. Points without a label, or with one
    that begins with * (unlabelled trajectories), are left out; so are analog channels and force plates, which `left_out`
    counts. Raises WearcapError without the library, and for a file that is damaged or shorter than it says.
    """
    conventions.only("unit", "up", where=path)
    c3d = required("c3d", "a C3D file")
    content, expected = read_bytes(path, "c3d"), "a whole C3D file: its header, parameters and frames"
    with understood("not a readable C3D file", path, expected, errors=_DAMAGE), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = c3d.Reader(io.BytesIO(content))
        used, rate = int(reader.point_used), float(reader.point_rate)
        if not 0 < rate < 1e5:
            raise ValueError(f"a rate of {rate} Hz")
        points = _points(reader, len(content))
        labels = [label for name in ("LABELS", "LABELS2", "LABELS3", "LABELS4") for label in _texts(reader, name)]
        labels = (labels + [""] * used)[:used]
        times = (reader.first_frame - 1 + np.arange(len(points))) / rate
        unit = ([*_texts(reader, "UNITS"), "mm"])[0] or "mm"
        screen = ([*_texts(reader, "Y_SCREEN"), "+Z"])[0].lower().removeprefix("+") or "z"
        left_out = _left_out(reader)
    kept = [k for k, label in enumerate(labels) if label and not label.startswith("*")]
    up = screen if conventions.up == AUTO else conventions.up
    unit_m, names = conventions.unit_m or UNITS_M.get(unit.lower()), [labels[k] for k in kept]
    markers = markers_of(path, names, times, points[:, kept], unit_m, up)
    return Markers(markers.timestamps, markers.names, markers.t_world_marker, left_out)


def _points(reader: Any, size: int) -> np.ndarray:
    """Points (time point 3) in the file's unit, NaN where not seen. Raises ValueError for more than the file can hold."""
    used, frames, word = int(reader.point_used), int(reader.frame_count), 4 if reader.point_scale < 0 else 2
    needed = frames * word * (4 * used + int(reader.analog_used) * int(reader.analog_per_frame))
    there = size - _BLOCK * (int(reader.header.data_block) - 1)
    if used < 1 or frames < 1 or needed > there:
        raise ValueError(f"{frames} frames of {used} points would take {needed} bytes, of which there are {there}")
    points = np.full((frames, used, 3), np.nan)
    for row, (_, values, _) in zip(points, reader.read_frames(copy=False)):
        row[:] = np.where(values[:, 3:4] < 0, np.nan, values[:, :3])
    return points


def _texts(reader: Any, name: str) -> list[str]:
    """Texts of a parameter of the group POINT, none where it is absent. (The library's own list has no bound.)"""
    parameter = reader.get(f"POINT:{name}")
    if parameter is None or not parameter.bytes:
        return []
    width, *counts = parameter.dimensions or [len(parameter.bytes)]
    if width * math.prod(counts) != len(parameter.bytes):
        raise ValueError(f"POINT:{name} of {parameter.dimensions} letters in {len(parameter.bytes)} bytes")
    texts = (parameter.bytes[start : start + width] for start in range(0, len(parameter.bytes), width))
    return [text.decode("utf-8", "replace").strip(" \0") for text in texts]


def _left_out(reader: Any) -> str:
    channels, plates = int(reader.analog_used), reader.get("FORCE_PLATFORM:USED")
    plates = int(plates.int16_value) if plates is not None and plates.bytes else 0
    counted = ((channels, "analog channels"), (plates, "force plates"))
    return " and ".join(f"{count} {name}" for count, name in counted if count > 0)
