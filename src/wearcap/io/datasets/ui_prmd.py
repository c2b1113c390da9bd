"""UI-PRMD (Vakanski et al. 2018): 39 Plug-in-Gait markers of exercises at 100 Hz, millimetres, z up.

A trial is a text file of the original, one frame a row, or `TRIAL.d2.npy.xz`: whole numbers, second differences in time of
hundredths of a millimetre. Neither has a header. Dropped markers are exact zeros.
"""

import re
from pathlib import Path

import numpy as np
import torch

from wearcap.boundary.arrays import read_npy
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.io.formats.trc import Markers

FPS = 100.0
NAMES = tuple(
    "LFHD RFHD LBHD RBHD C7 T10 CLAV STRN RBAK LSHO LUPA LELB LFRM LWRA LWRB LFIN RSHO RUPA RELB RFRM RWRA RWRB RFIN "
    "LASI RASI LPSI RPSI LTHI LKNE LTIB LANK LHEE LTOE RTHI RKNE RTIB RANK RHEE RTOE".split()
)
"""The order of the markers, inferred from Vicon's list and checked on left and right, front and back, and heights."""
MOVEMENTS = (
    *("deep squat", "hurdle step", "inline lunge", "side lunge", "sit to stand", "standing active straight leg raise"),
    *("standing shoulder abduction", "standing shoulder extension", "standing shoulder internal-external rotation"),
    "standing shoulder scaption",
)
_TRIAL = re.compile(r"m(\d\d)_(s\d\d)_e\d\d(_positions)?(_inc)?\.(d2\.npy|txt)(\.[gx]z)?")


def ui_prmd_trial(path: str | Path) -> tuple[str, str] | None:
    """Person and movement of a file by its name; None for a file that is no trial's."""
    match = _TRIAL.fullmatch(Path(path).name)
    number = int(match[1]) if match else 0
    return (match[2], MOVEMENTS[number - 1]) if match and 0 < number <= len(MOVEMENTS) else None


def read_ui_prmd(path: str | Path) -> Markers:
    """Markers of one trial. Raises WearcapError for a file that is not of either form."""
    if ".npy" in Path(path).suffixes:
        steps = read_npy(path)
        if steps.dtype.kind != "i" or steps.ndim != 2:
            raise WearcapError(f"an array of {steps.dtype}, {steps.ndim} axes", path, "rows of whole numbers")
        mm = steps.astype(np.int64).cumsum(0).cumsum(0) / 100.0
    else:
        rows = [
            finite_floats(re.split(r"[,\s]+", line.strip()), at_line(path, number))
            for number, line in numbered_lines(path, "table")
            if line.strip()
        ]
        mm = np.array(rows) if len({len(row) for row in rows}) == 1 else np.zeros((0, 0))
    if mm.shape[1] != 3 * len(NAMES) or not len(mm):
        raise WearcapError(f"{mm.shape[0]} rows of {mm.shape[1]} numbers", path, f"{3 * len(NAMES)} in every row")
    points = torch.from_numpy(mm.reshape(len(mm), -1, 3) / 1000)
    points[(points == 0).all(-1)] = torch.nan
    return Markers(torch.arange(len(points), dtype=torch.float64) / FPS, NAMES, points)
