"""CMU motion capture (ASF/AMC or its BVH conversions), plain, .xz or .gz."""

import csv
from collections.abc import Sequence
from pathlib import Path

from data_prep.bvh import Hips, motion_files, motion_tasks, stem_of, subjects_of
from data_prep.shared.engine import Splits, Task, source_folder
from data_prep.shared.mocap import MOCAP, About, MocapSettings
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import numbered_lines
from wearcap.errors import WearcapError
from wearcap.prepare.foreign_conventions import Mapping

LICENSE = (
    "Free for all uses; the data used in this project was obtained from mocap.cs.cmu.edu. The database was created with "
    "funding from NSF EIA-0196217."
)
VERSION = 5
"""Version of the conversion, increased when the same source and settings yield another recording."""


def cmu_tasks(
    # the folder with the trials, or a list of folders (searched as deep as they go)
    source: str | Path | Sequence[str | Path],
    splits: Splits,
    settings: MocapSettings = MOCAP,
    amc_fps: float | int = 120,  # not in AMC files
    license: str = LICENSE,
    repair: bool = True,  # move the hip joints so that knees straighten as people's do; false keeps the file's
    # the hips' usual shift ahead and up (m), for people who neither walk nor stand
    usual_m: Sequence[float] = (-0.012, 0.013),
    # null: the number in SUBJECT_TRIAL, else the folder; or a pattern with one group, folder, a name
    subject: str | None = None,
) -> list[Task]:
    """One task per trial found anywhere below `source`, a folder or several.

    Files are named SUBJECT_TRIAL.amc or .bvh (also .xz, .gz); an .amc needs SUBJECT.asf in its folder. Where a
    trial exists as both, the AMC is taken. A folder's `index.csv` (columns trial, category) provides activities.
    """
    trials: dict[str, Path] = {}
    subjects, activities = dict[str, str](), dict[str, str | None]()
    for folder in [source] if isinstance(source, str | Path) else source:
        root, own = source_folder(folder), dict[str, Path]()
        for path in motion_files(root):
            name = stem_of(path)
            known = own.get(name, trials.get(name))
            if known is not None and path.parent != known.parent:
                raise WearcapError(f"two trials are called {name!r}: {known} and {path}", fix="Rename one.")
            own.setdefault(name, path)  # .amc comes first
        trials, subjects = trials | own, subjects | subjects_of(root, own, subject)
        activities |= _activities(root / "index.csv")
    abouts = {name: About(name, subjects[name], "cmu", license, activities.get(name) or "") for name in trials}
    return motion_tasks(trials, abouts, splits, settings, amc_fps, Mapping(), Hips(repair, usual_m), VERSION)


def _activities(index: Path) -> dict[str, str | None]:
    """Categories by trial of an index, if it exists."""
    if not index.is_file():
        return {}
    with understood("not a list of trials", index, "columns trial,category", errors=csv.Error):
        rows = csv.DictReader(line for _, line in numbered_lines(index, "table"))
        return {row["trial"]: row.get("category") for row in rows if row.get("trial")}
