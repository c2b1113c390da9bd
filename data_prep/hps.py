"""HPS data set as it unpacks (hps_smpl, hps_betas, hps_inits, head_camera_localizations, …); bring your own download."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from data_prep.shared.engine import Splits, Task, source_folder
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.datasets.hps import hps_names, read_hps_sequence, resampled_localization, subject_of
from wearcap.recording.recording import Recording
from wearcap.recording.timing import resampled

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


def _hps(root: Path, name: str, fps: float | int, camera_hz: float | int, license: str) -> Recording:
    """Motion, suit and localisation at `fps`; the video keeps its own rate, the sensors theirs."""
    read = read_hps_sequence(root, name, camera_hz=camera_hz)
    assert read.motion is not None
    return replace(
        read,
        motion=resampled(read.motion, fps),
        license=license,
        suit=None if read.suit is None else resampled(read.suit, fps),
        localization=None if read.localization is None else resampled_localization(read.localization, fps),
    )


def hps_tasks(
    source: str | Path,  # the folder that holds hps_smpl and the others (scans unzipped in scans/)
    splits: Splits,
    fps: float | int = 30,  # motion, suit and localisation are brought to this rate
    camera_hz: float | int = 30,  # of the video that was localised; 29.97 where it was not resampled
    license: str = "HPS dataset licence; not to be passed on",
) -> list[Task]:
    """One task per sequence in `source`/hps_smpl; hashed by all files with its name and its subject's betas."""
    source = source_folder(source)
    names = hps_names(source)
    if not names:
        raise WearcapError("no sequences", where=source, expected="hps_smpl/NAME.pkl, as the HPS data set unpacks")
    tasks = []
    for name in names:
        subject = subject_of(name)
        patterns = (f"*/{name}[._]*", f"*betas*/{subject}.json", "*/cameras.json")
        files = sorted(path for pattern in patterns for path in source.glob(pattern))
        small = [path for path in files if path.suffix.lower() != ".mp4"]  # only a video's rate and length matter
        key = content_hash(name, float(fps), float(camera_hz), license, VERSION, *small)
        tasks.append(Task(name, partial(_hps, source, name, fps, camera_hz, license), splits.of(subject), key))
    return tasks
