"""Project Aria recordings: folders of MPS output (closed_loop_trajectory.csv, semi-dense points); plain, .gz or .xz."""

from functools import partial
from pathlib import Path

from data_prep.shared.engine import Splits, Task, changed, source_folder
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.devices.aria_mps import mps_files, read_mps
from wearcap.reading.any_file import of_name
from wearcap.reading.kinds import below

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
    folders = list(below(source, of_name("MPS")))
    if not folders:
        raise WearcapError("no MPS output", where=source, expected="folders with closed_loop_trajectory.csv")
    tasks = []
    for folder in folders:
        name = folder.resolve().name
        key = content_hash(name, subject, float(fps), VERSION, *mps_files(folder))
        read = partial(read_mps, folder, fps=float(fps))
        make = partial(changed, read, name=name, subject=subject, license=license)
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks
