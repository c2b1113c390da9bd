"""Project Aria recordings after Meta's machine perception services (MPS): head path and points, no body."""

from dataclasses import dataclass, replace
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.devices.aria_mps import is_mps_folder, mps_files, read_mps
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class AriaRecording:
    """One MPS output folder; picklable, callable as a task."""

    folder: Path
    name: str
    subject: str
    fps: float
    license: str

    def __call__(self) -> Recording:
        recording = read_mps(self.folder, fps=self.fps)
        return replace(recording, name=self.name, subject=self.subject, license=self.license)


def aria_tasks(source: str | Path, splits: Splits, subject: str, fps: float | int, license: str) -> list[Task]:
    """One task per closed-loop trajectory at or below `source`, named after its recording's folder."""
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    recordings = _recordings(source)
    if not recordings:
        raise WearcapError("no MPS output", where=source, expected="folders with closed_loop_trajectory.csv")
    tasks = []
    for folder in recordings:
        name = folder.resolve().name
        digest = content_hash(name, subject, float(fps), VERSION, *mps_files(folder))
        tasks.append(Task(name, AriaRecording(folder, name, subject, float(fps), license), splits.of(subject), digest))
    return tasks


def _recordings(source: Path) -> list[Path]:
    """The outermost folder of each trajectory: REC of REC/slam and REC/mps/slam, too."""
    folders: dict[Path, Path] = {}
    for folder in sorted([source, *(path for path in source.rglob("*") if path.is_dir())]):
        if is_mps_folder(folder):
            folders.setdefault(mps_files(folder)[0], folder)
    return list(folders.values())
