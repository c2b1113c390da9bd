"""BEHAVE: the user's own download, a recording and an environment per sequence."""

from dataclasses import asdict, dataclass
from pathlib import Path

from wearcap.io.datasets.behave import BODY_FILE, INFO_FILE, OBJECT_FILE, behave_folder, behave_names, read_behave
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.mocap import About, MocapSettings
from wearcap.prepare.one_object import on_level_ground, one_object_recording
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class BehaveSequence:
    """One sequence; picklable, callable as a task."""

    root: Path
    name: str
    settings: MocapSettings
    license: str
    output: Path

    def __call__(self) -> Recording:
        """Body and object on level ground at z = 0; the environment is written beside the recording."""
        take = on_level_ground(read_behave(self.root, self.name), self.settings.limits)
        about = About(self.name, take.subject, "BEHAVE", self.license, take.activity)
        return one_object_recording(take, about, self.settings, self.output)


def behave_tasks(
    source: str | Path, output: str | Path, splits: Splits, settings: MocapSettings, license: str
) -> list[Task]:
    """One task per sequence of `source`; environments go to `output`/scenes. The split list's rows are sequences.

    Raises WearcapError without sequences.
    """
    source = Path(source)
    meshes = sorted(source.glob("objects/*/*_f*.ply"))
    shared = content_hash(asdict(settings), license, VERSION, *meshes)
    tasks, sequences = [], behave_folder(source)
    for name in behave_names(source):
        files = [
            sequences / name / file
            for file in (BODY_FILE, OBJECT_FILE, INFO_FILE)
            if (sequences / name / file).is_file()
        ]
        make = BehaveSequence(source, name, settings, license, Path(output))
        tasks.append(Task(name, make, splits.of(name), content_hash(name, shared, *files)))
    return tasks
