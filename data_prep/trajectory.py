"""The path of a head's own device by any SLAM."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.io.devices.aria_mps import is_mps_folder
from wearcap.io.formats.trajectory import trajectory_file, trajectory_format
from wearcap.prepare.engine import Splits, Task, content_hash
from wearcap.prepare.logs import TrajectorySettings, log_name, read_path
from wearcap.recording.recording import Recording

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


def trajectory_tasks(
    source: str | Path, splits: Splits, subject: str, license: str, settings: TrajectorySettings
) -> list[Task]:
    """One task per trajectory: a file, a folder that is one, or each trajectory in a folder.

    Raises WearcapError where there is none, and for points, a video or an inertial log of several trajectories.
    """
    source = Path(source)
    if not source.exists():
        raise WearcapError("no such file or folder", where=source, fix="Give it as source=FILE or source=DIR.")
    if source.is_dir() and not is_mps_folder(source) and trajectory_file(source) is None:
        found = [path for path in sorted(source.iterdir()) if path.is_dir() and trajectory_file(path)]
        found += [path for path in sorted(source.iterdir()) if path.is_file() and trajectory_format(path)]
    else:
        found = [source]
    if not found:
        raise WearcapError("no trajectory in this folder", source, "a file that wearcap doctor knows as one")
    if len(found) > 1 and (settings.files() or settings.video.video):
        what = f"{len(found)} trajectories, but points, video or head_imu of one"
        raise WearcapError(what, where=source, fix="Prepare that one alone: source=FILE.")
    files = settings.files()
    return [
        log_task("trajectory", VERSION, path, read_path, splits, subject, license, settings, files) for path in found
    ]


def log_task(
    kind: str,
    version: int,
    path: Path,
    make: Callable[..., Recording],
    splits: Splits,
    subject: str,
    license: str,
    settings: Any,
    files: Sequence[Path] = (),
) -> Task:
    """A task that is hashed by its files and settings, and named after its file or folder."""
    name = log_name(path)
    read = [path] if path.is_file() else [file for file in sorted(path.rglob("*")) if file.is_file()]
    small = [file for file in (*read, *files) if file.stat().st_size < 1 << 30]
    key = content_hash(kind, name, subject, license, asdict(settings), version, *small)
    about = {
        "subject": subject,
        "license": license,
        "source": f"{kind} {path.name if path.suffix != '.bsor' else name}",
    }
    return Task(name or kind, partial(make, path, name or kind, about, settings), splits.of(subject), key)
