"""The HPS data set: the user's own download, sequences by name."""

from dataclasses import dataclass, replace
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.hps import resampled_localization
from wearcap.io.datasets.hps_sequence import hps_names, read_hps_sequence, subject_of
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.recording.timing import resampled

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class HpsSequence:
    """One sequence; picklable, callable as a task."""

    root: Path
    name: str
    fps: float | int
    camera_hz: float | int
    license: str

    def __call__(self) -> Recording:
        """Motion, suit and localisation at `fps`; the video keeps its own rate, the sensors theirs."""
        read = read_hps_sequence(self.root, self.name, camera_hz=self.camera_hz)
        assert read.motion is not None
        suit, found = read.suit, read.localization
        return replace(
            read,
            motion=resampled(read.motion, self.fps),
            license=self.license,
            suit=None if suit is None else resampled(suit, self.fps),
            localization=None if found is None else resampled_localization(found, self.fps),
        )


def hps_tasks(source: str | Path, splits: Splits, fps: float | int, camera_hz: float | int, license: str) -> list[Task]:
    """One task per sequence in `source`/hps_smpl; hashed by all files with its name and its subject's betas."""
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    names = hps_names(source)
    if not names:
        raise WearcapError("no sequences", where=source, expected="hps_smpl/NAME.pkl, as the HPS data set unpacks")
    tasks = []
    for name in names:
        subject = subject_of(name)
        files = sorted(
            [*source.glob(f"*/{name}[._]*"), *source.glob(f"*betas*/{subject}.json"), *source.glob("*/cameras.json")]
        )
        small = [path for path in files if path.suffix.lower() != ".mp4"]  # only a video's rate and length matter
        sequence = HpsSequence(source, name, fps, camera_hz, license)
        settings_hash = content_hash(name, float(fps), float(camera_hz), license, VERSION, *small)
        tasks.append(Task(name, sequence, splits.of(subject), settings_hash))
    return tasks
