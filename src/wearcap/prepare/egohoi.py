"""EgoHOI: the user's own download, a recording and an environment per sequence."""

from dataclasses import dataclass, replace
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.egohoi import egohoi_names, read_egohoi
from wearcap.io.datasets.hps_sequence import subject_of
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.recording.timing import resampled

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class EgoHoiSequence:
    """One sequence; picklable, callable as a task."""

    root: Path
    name: str
    motion_types: dict[str, str]
    object_name: str | None
    fps: float | int
    license: str
    output: Path

    def __call__(self) -> Recording:
        """Recording with the body at `fps` and the annotated object poses; the environment is written beside it."""
        recording, environment = read_egohoi(self.root, self.name, self.motion_types, self.object_name)
        assert recording.motion is not None
        file = Path("scenes") / self.name / FILE_NAME
        write_environment(environment, self.output / file)
        return replace(
            recording, motion=resampled(recording.motion, self.fps), environment=file.as_posix(), license=self.license
        )


def egohoi_tasks(
    source: str | Path,
    output: str | Path,
    splits: Splits,
    motion_types: dict[str, str],
    object_names: dict[str, str],
    fps: float | int,
    license: str,
) -> list[Task]:
    """One task per sequence in `source`/smpl_motions; environments go to `output`/scenes.

    `motion_types` and `object_names` as `read_egohoi` takes them, the latter by sequence. Raises WearcapError without
    sequences.
    """
    source = Path(source)
    names = egohoi_names(source)
    if not names:
        raise WearcapError(
            "no sequences",
            where=source,
            expected="smpl_motions/NAME.json.zip or .json",
            fix="Give EgoHOI's folder as source=DIR.",
        )
    models = sorted(source.glob("object_models/*.ply"))
    tasks = []
    for name in names:
        files = [*sorted(source.glob(f"*/{name}.json*")), *sorted(source.glob(f"*/{name}/*.json"))]
        shape = source / "smpl_shapes" / f"{subject_of(name)}.json"
        make = EgoHoiSequence(source, name, motion_types, object_names.get(name), fps, license, Path(output))
        settings_hash = content_hash(
            name,
            motion_types,
            make.object_name,
            float(fps),
            license,
            VERSION,
            *files,
            *models,
            *([shape] if shape.is_file() else []),
        )
        tasks.append(Task(name, make, splits.of(subject_of(name)), settings_hash))
    return tasks
