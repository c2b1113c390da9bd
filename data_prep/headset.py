"""Logs of headsets with controllers or hands."""

from pathlib import Path

from data_prep.trajectory import log_task
from wearcap.errors import WearcapError
from wearcap.prepare.engine import Splits, Task
from wearcap.prepare.logs import HeadsetSettings
from wearcap.reading.any_file import of_name
from wearcap.reading.kinds import below
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


def _headset(path: Path, name: str, about: dict[str, str], settings: HeadsetSettings) -> Recording:
    return settings.read(path, name, about)


def headset_tasks(
    source: str | Path, splits: Splits, subject: str, license: str, settings: HeadsetSettings
) -> list[Task]:
    """One task per log: a file, or each in a folder. Raises WearcapError where there is none."""
    source = Path(source)
    if not source.exists():
        raise WearcapError("no such file or folder", where=source, fix="Give it as source=FILE or source=DIR.")
    found = list(below(source, of_name("headset"))) if source.is_dir() else [source]
    if not found:
        raise WearcapError("no headset's log in this folder", source, "CSV or JSON with time, head_pos_x, …")
    return [log_task("headset", VERSION, path, _headset, splits, subject, license, settings) for path in found]
