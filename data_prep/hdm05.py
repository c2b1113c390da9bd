"""HDM05 motion capture (ASF/AMC), plain, .xz or .gz, cut into clips that are named HDM_PERSON_ACTION_NUMBER_120."""

from collections.abc import Sequence
from pathlib import Path

from data_prep.bvh import bvh_tasks
from wearcap.prepare.engine import Splits, Task
from wearcap.prepare.mocap import MOCAP, MocapSettings

LICENSE = (
    "CC BY-SA 3.0; the data used in this project was obtained from HDM05 (M. Müller, T. Röder, M. Clausen, B. Eberhardt, "
    "B. Krüger, A. Weber: Documentation Mocap Database HDM05, Universität Bonn, CG-2007-2, 2007)."
)


def hdm05_tasks(
    source: str | Path,  # the folder with the files (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = LICENSE,
    subject: str = r"HDM_([a-z]+)_",  # a pattern with one group, folder, a name
    activity: str | None = r"HDM_[a-z]+_([A-Za-z]+)",  # null: none; or a pattern with one group, folder, a name
    repair: bool = True,  # move the hip joints so that knees straighten as people's do; false keeps the file's
    usual_m: Sequence[float] = (
        -0.012,
        0.013,
    ),  # the hips' usual shift ahead and up (m), for people who neither walk nor stand
) -> list[Task]:
    """One task per file, as `bvh_tasks` has it."""
    hips = {"repair": repair, "usual_m": usual_m}
    return bvh_tasks(source, splits, settings, license=license, subject=subject, activity=activity, **hips)
