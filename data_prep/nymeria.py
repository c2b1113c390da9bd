"""Nymeria and NymeriaPlus: an Xsens suit under Project Aria glasses."""

from functools import partial
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.nymeria import head_vrs, read_metadata, read_nymeria
from wearcap.io.devices.aria_mps import mps_files
from wearcap.prepare.engine import Splits, Task, changed, content_hash, source_folder
from wearcap.reading.any_file import below

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


def nymeria_tasks(
    source: str | Path, splits: Splits, fps: float | int, license: str, camera: bool = False, output: str = "."
) -> list[Task]:
    """One task per sequence folder (with `body/xdata.npz`) below `source`; hashed by its motion, head path and points.

    With `camera`, the video of the head's colour camera is written to `output`/videos, for sequences with `data.vrs`.
    """
    source = source_folder(source)
    folders = list(below(source, "Nymeria"))
    if not folders:
        raise WearcapError("no sequences", where=source, expected="folders with body/xdata.npz")
    tasks = []
    for folder in folders:
        name, about, vrs = folder.resolve().name, read_metadata(folder), head_vrs(folder)
        video = Path(output) / "videos" / f"{name}.mp4" if camera and vrs.is_file() else None
        files = [folder / "body" / "xdata.npz", *mps_files(folder / "recording_head")]
        filmed_bytes = vrs.stat().st_size if video else 0
        key = content_hash(name, float(fps), VERSION, about, *files, filmed_bytes)
        read = partial(read_nymeria, folder, fps=float(fps), video=video)
        tasks.append(Task(name, partial(changed, read, name=name, license=license), splits.of(about["subject"]), key))
    return tasks
