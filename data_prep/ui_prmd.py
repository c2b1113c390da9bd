"""UI-PRMD, exercises of physical rehabilitation: 39 optical markers at 100 Hz, the original's text files or packed ones.

Vakanski et al. 2018: Plug-in-Gait markers in millimetres, z up, dropped ones zero.

A trial is a text file of the original, one frame a row, or `TRIAL.d2.npy.xz`: second differences in time of hundredths of a
millimetre. The markers' order, which no file states, was inferred from Vicon's list and checked on sides and heights.
"""

from pathlib import Path

import numpy as np
import torch

from data_prep.markers import marker_tasks
from data_prep.shared.engine import Splits, Task
from data_prep.shared.mocap import MOCAP, MocapSettings
from wearcap.boundary.arrays import read_npy
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.formats.trc import Markers

FPS = 100.0
_TRUNK, _ARM, _LEG = (
    "LFHD RFHD LBHD RBHD C7 T10 CLAV STRN RBAK",
    "SHO UPA ELB FRM WRA WRB FIN",
    "THI KNE TIB ANK HEE TOE",
)
_LIMBS = [side + name for limb in (_ARM, "ASI", "PSI", _LEG) for side in "LR" for name in limb.split()]
NAMES = (*_TRUNK.split(), *_LIMBS)


def read_ui_prmd(path: str | Path) -> Markers:
    """Markers of one trial. Raises WearcapError for a file that is not of either form."""
    if ".npy" in Path(path).suffixes:
        steps = read_npy(path)
        steps = steps.astype(np.int64) if steps.dtype.kind == "i" and steps.ndim == 2 else np.zeros((0, 0), np.int64)
        mm = steps.cumsum(0).cumsum(0) / 100.0
    else:
        lines = [(number, line.replace(",", " ").split()) for number, line in numbered_lines(path, "table")]
        rows = [finite_floats(words, at_line(path, number)) for number, words in lines if len(words) == 3 * len(NAMES)]
        mm = np.array(rows) if len(rows) == len(lines) else np.zeros((0, 0))
    if not mm.size or mm.shape[1] != 3 * len(NAMES):
        raise WearcapError("no trial of UI-PRMD", path, f"rows of {3 * len(NAMES)} numbers (whole ones in .d2.npy)")
    points = torch.from_numpy(mm.reshape(len(mm), -1, 3) / 1000)
    points[(points == 0).all(-1)] = torch.nan
    return Markers(torch.arange(len(points), dtype=torch.float64) / FPS, NAMES, points)


LICENSE = (
    "Open Data Commons Public Domain Dedication and License (PDDL) v1.0; A. Vakanski, H. Jun, D. Paul, R. Baker: A Data Set "
    "of Human Body Movements for Physical Rehabilitation Exercises, Data 2018, 3(1), 2."
)
ACTIVITIES = {
    "m01": "deep squat",
    "m02": "hurdle step",
    "m03": "inline lunge",
    "m04": "side lunge",
    "m05": "sit to stand",
    "m06": "standing active straight leg raise",
    "m07": "standing shoulder abduction",
    "m08": "standing shoulder extension",
    "m09": "standing shoulder internal-external rotation",
    "m10": "standing shoulder scaption",
}


def ui_prmd_tasks(
    source: str | Path,  # the folder with the trials (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = LICENSE,
    # their names: movement, person, repetition; those of badly done ones (_inc) are motion, too
    files: str = "m??_s??_e??*",
) -> list[Task]:
    """One task per trial, a body per person."""
    rules, how = (r"_(s\d\d)_", r"(m\d\d)_"), Conventions()
    return marker_tasks("ui_prmd", source, splits, settings, license, files, rules, ACTIVITIES, how, _read)


def _read(path: Path, how: Conventions) -> Markers:
    return read_ui_prmd(path)
