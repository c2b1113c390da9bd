"""Nymeria and NymeriaPlus: the user's own download, one folder per sequence."""

from dataclasses import dataclass, replace
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.nymeria import head_vrs, is_nymeria, read_metadata, read_nymeria
from wearcap.io.devices.aria_mps import mps_files
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class NymeriaSequence:
    """One sequence's folder; picklable, callable as a task."""

    folder: Path
    name: str
    fps: float | int
    license: str
    video: Path | None = None

    def __call__(self) -> Recording:
        recording = read_nymeria(self.folder, fps=float(self.fps), video=self.video)
        return replace(recording, name=self.name, license=self.license)


def nymeria_tasks(
    source: str | Path, splits: Splits, fps: float | int, license: str, camera: bool = False, output: str = "."
) -> list[Task]:
    """One task per sequence folder (with `body/xdata.npz`) below `source`; hashed by its motion, head path and points.

    With `camera`, the video of the head's colour camera is written to `output`/videos, for sequences with `data.vrs`.
    """
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    folders = sorted(path.parents[1] for path in source.rglob("xdata.npz") if is_nymeria(path.parents[1]))
    if not folders:
        raise WearcapError("no sequences", where=source, expected="folders with body/xdata.npz")
    tasks = []
    for folder in folders:
        name = folder.resolve().name
        about = read_metadata(folder)
        paths = mps_files(folder / "recording_head")
        vrs = head_vrs(folder)
        video = Path(output) / "videos" / f"{name}.mp4" if camera and vrs.is_file() else None
        sequence = NymeriaSequence(folder, name, fps, license, video)
        settings_hash = content_hash(
            name, float(fps), VERSION, about, folder / "body" / "xdata.npz", *paths, vrs.stat().st_size if video else 0
        )
        tasks.append(Task(name, sequence, splits.of(about["subject"]), settings_hash))
    return tasks
