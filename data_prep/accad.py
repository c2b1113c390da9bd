"""ACCAD motion capture (BVH, plain, .xz or .gz), in files that are named PERSON_ACTION."""

from collections.abc import Sequence
from pathlib import Path

from data_prep.bvh import bvh_tasks
from wearcap.prepare.engine import Splits, Task
from wearcap.prepare.mocap import MOCAP, MocapSettings

LICENSE = (
    "CC BY 3.0; motion capture data: Advanced Computing Center for the Arts and Design (ACCAD), The Ohio State "
    "University."
)


def accad_tasks(
    source: str | Path,  # the folder with the files (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = LICENSE,
    subject: str = r"([A-Za-z]+\d+)_",  # a pattern with one group, folder, a name
    activity: str | None = r"_([A-Za-z]{3,})",  # null: none; or a pattern with one group, folder, a name
    repair: bool = True,  # move the hip joints so that knees straighten as people's do; false keeps the file's
    usual_m: Sequence[float] = (
        0.0,
        0.012,
    ),  # the hips' usual shift ahead and up (m), for people who neither walk nor stand
) -> list[Task]:
    """One task per file, as `bvh_tasks` has it."""
    hips = {"repair": repair, "usual_m": usual_m}
    return bvh_tasks(source, splits, settings, license=license, subject=subject, activity=activity, **hips)
