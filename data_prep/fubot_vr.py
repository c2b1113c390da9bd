"""FuBoT-VR: one person in an inertial suit who plays VR games (BVH, plain, .xz or .gz), in files named GAME_NUMBER.

The split is by game."""

from collections.abc import Sequence
from pathlib import Path

from data_prep.bvh import bvh_tasks
from wearcap.prepare.engine import Splits, Task
from wearcap.prepare.mocap import MOCAP, MocapSettings

LICENSE = "MIT; FuBoT-VR data set, Tomiha, github.com/Tomiha/FuBoT-VR-Dataset."


def fubot_vr_tasks(
    source: str | Path,  # the folder with the files (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = LICENSE,
    subject: str = r"([a-z]+)_\d+",  # a pattern with one group, folder, a name
    activity: str | None = r"([a-z]+)_\d+",  # null: none; or a pattern with one group, folder, a name
    repair: bool = False,  # move the hip joints so that knees straighten as people's do; false keeps the file's
    usual_m: Sequence[float] = (
        0.0,
        0.0,
    ),  # the hips' usual shift ahead and up (m), for people who neither walk nor stand
) -> list[Task]:
    """One task per file, as `bvh_tasks` has it."""
    hips = {"repair": repair, "usual_m": usual_m}
    return bvh_tasks(source, splits, settings, license=license, subject=subject, activity=activity, **hips)
