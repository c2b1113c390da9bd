"""Project Aria recordings: folders of MPS output (closed_loop_trajectory.csv, semi-dense points); plain, .gz or .xz."""

from functools import partial
from pathlib import Path

from data_prep.shared.engine import Splits, Task, changed, source_folder
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.devices.aria_mps import is_mps_folder, mps_files, read_mps

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


def aria_tasks(
    source: str | Path,  # a folder of MPS output, or one that holds such folders
    splits: Splits,
    subject: str = "wearer",
    fps: float | int = 60.0,
    license: str = "the recording's own",
) -> list[Task]:
    """One task per closed-loop trajectory at or below `source`, named after its recording's folder."""
    source = source_folder(source)
    folders: dict[Path, Path] = {}  # by trajectory, the outermost folder: REC of REC/slam and REC/mps/slam, too
    for folder in sorted([source, *(path for path in source.rglob("*") if path.is_dir())]):
        if is_mps_folder(folder):
            folders.setdefault(mps_files(folder)[0], folder)
    if not folders:
        raise WearcapError("no MPS output", where=source, expected="folders with closed_loop_trajectory.csv")
    tasks = []
    for folder in folders.values():
        name = folder.resolve().name
        key = content_hash(name, subject, float(fps), VERSION, *mps_files(folder))
        read = partial(read_mps, folder, fps=float(fps))
        make = partial(changed, read, name=name, subject=subject, license=license)
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks
