"""C3D files of known markers, written by the library `c3d`."""

import warnings
from pathlib import Path

import numpy as np
import torch

from wearcap.io.formats.trc import Markers


def write_c3d(
    markers: Markers,
    path: Path,
    unit: str = "mm",
    prefix: str = "Anna:",
    screen: str = "+Z",
    first: int = 1,
    analog: int = 0,
) -> Path:
    """Markers as C3D, z up unless `screen` is +Y; those not seen with residual -1, one as NaN."""
    import c3d

    per_unit = {"mm": 1000.0, "m": 1.0}[unit]
    places = markers.t_world_marker.numpy() * per_unit
    places = places[..., [0, 2, 1]] * [1, 1, -1] if screen == "+Y" else places
    points = np.zeros((*places.shape[:2], 5), np.float32)
    lost = np.isnan(places).any(-1)
    points[..., :3], points[lost, 3] = np.nan_to_num(places), -1
    writer = c3d.Writer(
        point_rate=100.0, analog_rate=200.0 if analog else 0.0, point_scale=-1.0, point_units=unit.ljust(4)
    )
    writer.set_start_frame(first)
    writer.set_point_labels([prefix + name for name in markers.names])
    if analog:
        writer.set_analog_labels([f"F{k}" for k in range(analog)])
    writer.set_screen_axis(Y=screen)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for frame in points:
            writer.add_frames([(frame, np.ones((analog, 2 if analog else 0)))])
        with open(path, "wb") as file:
            writer.write(file)
    return path


def trial(frames: int = 7, names: tuple[str, ...] = ("LASI", "RASI")) -> Markers:
    """Random places, of which one was not seen."""
    places = torch.randn(frames, len(names), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places[2, 1] = torch.nan
    return Markers(torch.arange(frames).double() / 100, names, places)
