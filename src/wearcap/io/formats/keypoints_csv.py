"""Recorded keypoints as CSV: timestamp (s), joint, x, y (pixels) or x, y, z (m, in the world), confidence (0…1).

A row is one joint at one time, in any order. A file holds pixels or 3D positions, not both.
"""

from pathlib import Path

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.io.formats.csv_table import read_columns, read_header
from wearcap.recording.recording import Cue

_AXES = "xyz"
_MAX_PLACE = 1e9
"""Largest coordinate (m or pixels); larger numbers need not be finite as float32."""


def read_keypoints(path: str | Path) -> dict[str, Cue]:
    """Cues by joint, with rising times. Rows with a confidence of 0 carry no information and are dropped.

    Raises WearcapError for a missing column, a field that is no number, a time, place or confidence that cannot be one,
    and a joint that occurs twice at one time. Whether a skeleton has the joints is not checked here.
    """
    axes = list(_AXES if "z" in read_header(path) else _AXES[:2])
    table = read_columns(path, ["timestamp", *axes, "confidence"], text=["joint"])
    times, confidence = table["timestamp"], table["confidence"]
    points = np.stack([table[axis] for axis in axes], -1)
    joints = np.char.strip(np.char.decode(table["joint"], "latin-1"))
    observed = confidence != 0
    for wrong, what, expected in (
        (~np.isfinite(times), "a timestamp that is no time", "seconds"),
        (~((confidence >= 0) & (confidence <= 1)), "a confidence that is none", "0 to 1"),
        (observed & ~(np.abs(points) <= _MAX_PLACE).all(-1), "a place that is none", "numbers, or a confidence of 0"),
        (joints == "", "no joint", "a joint's name"),
    ):
        if wrong.any():
            raise WearcapError(what, where=f"{path}, row {int(wrong.argmax()) + 1} after the header", expected=expected)
    cues = {}
    for joint in map(str, np.unique(joints[observed])):
        rows = np.flatnonzero(observed & (joints == joint))
        rows = rows[np.argsort(times[rows], kind="stable")]
        twice = rows[1:][np.diff(times[rows]) == 0]
        if len(twice):
            what = f"{joint!r} is twice at {times[twice[0]]:.6f} s"
            raise WearcapError(what, where=path, expected="one row per joint and time")
        place, sure = (torch.from_numpy(part[rows]).float() for part in (points, confidence))
        cues[joint] = Cue(torch.from_numpy(times[rows]), joint, place, sure)
    return cues
