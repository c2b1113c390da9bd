"""Berkeley MHAD's skeletons (BVH, plain, .xz or .gz), in files that are named skl_PERSON_ACTION_REPETITION."""

from collections.abc import Sequence
from pathlib import Path

from data_prep.bvh import bvh_tasks
from wearcap.prepare.engine import Splits, Task
from wearcap.prepare.mocap import MOCAP, MocapSettings

LICENSE = (
    "Copyright (c) 2013, The Regents of the University of California. Read the terms on the data set's page before "
    "sharing what is trained on it."
)


def berkeley_mhad_tasks(
    source: str | Path,  # the folder with the files (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = LICENSE,
    subject: str = r"skl_(s\d+)_",  # a pattern with one group, folder, a name
    activity: str | None = r"skl_s\d+_([a-z0-9]+)",  # null: none; or a pattern with one group, folder, a name
    repair: bool = True,  # move the hip joints so that knees straighten as people's do; false keeps the file's
    usual_m: Sequence[float] = (
        0.0,
        0.0,
    ),  # the hips' usual shift ahead and up (m), for people who neither walk nor stand
) -> list[Task]:
    """One task per file, as `bvh_tasks` has it."""
    hips = {"repair": repair, "usual_m": usual_m}
    return bvh_tasks(source, splits, settings, license=license, subject=subject, activity=activity, **hips)
