"""Logs of headsets with controllers or hands (Quest, Vive, Pico; OpenXR, Unity, SteamVR): CSV, JSON, JSON lines."""

from collections.abc import Sequence
from pathlib import Path

from data_prep.shared.engine import Splits, Task
from data_prep.trajectory import log_task
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO
from wearcap.prepare.logs import HeadsetSettings
from wearcap.reading.any_file import of_name
from wearcap.reading.kinds import below
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


def _headset(path: Path, name: str, about: dict[str, str], settings: HeadsetSettings) -> Recording:
    return settings.read(path, name, about)


def headset_tasks(
    source: str | Path,  # a log, or a folder of logs
    splits: Splits,
    subject: str = "wearer",
    license: str = "the recording's own",
    # of the wearer (m); null: from how high the head is carried, when it is captured
    height: float | int | None = None,
    unit: str | float | int = AUTO,  # of length: m, cm, mm, or metres per unit
    # unity (left-handed, y up), openxr (right-handed, y up, -z forward), steamvr (as openxr), unreal (left-handed, z
    # up)
    axes: str = AUTO,
    quaternion: str = AUTO,  # order where columns do not name it: xyzw, wxyz
    # wrist, palm (hand joints); of a controller grip, aim (OpenXR's poses), touch, index, vive (the device's own)
    hands: str = AUTO,
    time_unit: str | None = None,  # s, ms, us, ns; null: from the numbers
    # headset on the head joint: [x,y,z] or [x,y,z,qw,qx,qy,qz]; null: [0.09,0,0.075]
    T_head_device: Sequence[float | int] | None = None,
) -> list[Task]:
    """One task per log: a file, or each in a folder. Raises WearcapError where there is none."""
    source = Path(source)
    if not source.exists():
        raise WearcapError("no such file or folder", where=source, fix="Give it as source=FILE or source=DIR.")
    settings = HeadsetSettings(unit, axes, quaternion, hands, time_unit, T_head_device, height)
    found = list(below(source, of_name("headset"))) if source.is_dir() else [source]
    if not found:
        raise WearcapError("no headset's log in this folder", source, "CSV or JSON with time, head_pos_x, …")
    return [log_task("headset", VERSION, path, _headset, splits, subject, license, settings) for path in found]
