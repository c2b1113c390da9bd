"""Logs of headsets with controllers or hands."""

from pathlib import Path

from data_prep.shared.engine import Splits, Task
from data_prep.trajectory import log_task
from wearcap.errors import WearcapError
from wearcap.io.devices.headset_log import is_headset_log, is_headset_session
from wearcap.prepare.logs import HeadsetSettings
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
    kinds = (".csv", ".tsv", ".json", ".jsonl", ".txt", ".bsor")
    found = [source]
    if source.is_dir() and not is_headset_session(source):
        there = sorted(source.rglob("*"))
        found = [path for path in there if path.is_dir() and path.name != "trackers" and is_headset_session(path)]
        files = [path for path in there if path.is_file() and set(path.suffixes) & set(kinds)]
        found += [path for path in files if not set(path.parents) & set(found) and is_headset_log(path)]
    if not found:
        raise WearcapError("no headset's log in this folder", source, "CSV or JSON with time, head_pos_x, …")
    return [log_task("headset", VERSION, path, _headset, splits, subject, license, settings) for path in found]
