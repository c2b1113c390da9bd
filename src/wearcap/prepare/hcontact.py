"""H-contact: the user's own download, a recording per sequence."""

from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.hcontact import ENDING, hcontact_names, read_hcontact, read_hcontact_split
from wearcap.io.datasets.hps_sequence import subject_of
from wearcap.prepare.engine import NOTE, Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.recording.timing import resampled

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class HContactSequence:
    """One sequence; picklable, callable as a task."""

    root: Path
    name: str
    contact_class: str
    fps: float | int
    license: str

    def __call__(self) -> Recording:
        """The motion at `fps`; contacts keep their times."""
        read = read_hcontact(self.root, self.name, self.contact_class)
        assert read.motion is not None
        motion = resampled(read.motion, self.fps)
        if not read.motion.t_world_root.any():
            motion = replace(motion, provenance=motion.provenance | {NOTE: "the body's place is not known"})
        return replace(read, motion=motion, license=self.license)


def hcontact_tasks(
    source: str | Path, splits: Splits, classes: dict[str, str], fps: float | int, license: str
) -> list[Task]:
    """One task per sequence in `source`/body; `classes` maps patterns of names to contact classes, the first match decides.

    If the data set's own `splits/` exists, a subject without training windows belongs to test, regardless of the list.
    Raises WearcapError without sequences, and for a name that no pattern matches.
    """
    source = Path(source)
    names = hcontact_names(source)
    if not names:
        raise WearcapError(
            "no sequences",
            where=source,
            expected=f"body/NAME{ENDING} and contacts/NAME.json",
            fix="Give H-contact's folder as source=DIR.",
        )
    held_out = held_out_subjects(source, names)
    tasks = []
    for name in names:
        kind = next((kind for pattern, kind in classes.items() if fnmatchcase(name, pattern)), None)
        if kind is None:
            raise WearcapError(
                f"no contact class for sequence {name!r}", expected="a pattern of `classes` that matches it"
            )
        subject = subject_of(name)
        files = [source / "body" / f"{name}{ENDING}", source / "contacts" / f"{name}.json"]
        there = [path for path in files if path.is_file()]
        settings_hash = content_hash(name, kind, float(fps), license, VERSION, *there)
        split = "test" if subject in held_out else splits.of(subject)
        tasks.append(Task(name, HContactSequence(source, name, kind, fps, license), split, settings_hash))
    return tasks


def held_out_subjects(source: Path, names: list[str]) -> set[str]:
    """Subjects with windows in the data set's own splits, none of them for training."""
    listed: dict[str, bool] = {}
    for path in sorted(source.glob("splits/**/*.json")):
        if path.stem in names:
            trains = bool(read_hcontact_split(path).train)
            listed[subject_of(path.stem)] = listed.get(subject_of(path.stem), False) or trains
    return {subject for subject, trains in listed.items() if not trains}
