"""AMASS: the user's own download, SMPL-H or SMPL-X files."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from wearcap.errors import WearcapError, nearest
from wearcap.io.datasets.amass import read_amass
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""

NO_MOTION = ("shape.npz", "stagei.npz")
"""Name suffixes of files that hold no motion."""


@dataclass(frozen=True)
class AmassFile:
    """One motion file; picklable, callable as a task."""

    file: Path
    about: About
    settings: MocapSettings

    def __call__(self) -> Recording:
        source = read_amass(self.file)
        assert source.motion is not None
        return replace(mocap_recording(source.motion, self.about, self.settings), shape=source.shape)


def amass_tasks(
    source: str | Path, splits: Splits, settings: MocapSettings, license: str, subsets: Sequence[str] | None = None
) -> list[Task]:
    """One task per motion file below `source`, laid out DATASET/SUBJECT/MOTION.npz, of all data sets or of `subsets`.

    A row of the split list that names a file (DATASET/SUBJECT/MOTION) takes precedence over its subject's.
    """
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    files = sorted(path for path in source.rglob("*.npz") if not path.name.endswith(NO_MOTION))
    if subsets is not None:
        files = _within(files, source, subsets)
    by_file = {row for row, _ in splits.rows if row.count("/") > 1}
    tasks = []
    for path in files:
        parts = path.relative_to(source).with_suffix("").parts
        if len(parts) < 3:
            raise WearcapError(
                "not below a data set's and a subject's folder",
                where=path,
                expected=f"{source}/DATASET/SUBJECT/{path.name}",
            )
        name, subject, file = "__".join(parts).replace(" ", "_"), "/".join(parts[:2]), "/".join(parts)
        about = About(name, subject, "amass", license)
        settings_hash = content_hash(asdict(about), asdict(settings), VERSION, path)
        split = splits.of(file if file in by_file else subject)
        tasks.append(Task(name, AmassFile(path, about, settings), split, settings_hash))
    if not tasks:
        raise WearcapError("no motion files (.npz)", where=source, expected="AMASS as it unpacks")
    return tasks


def _within(files: list[Path], source: Path, subsets: Sequence[str]) -> list[Path]:
    """Files of the named data sets. Raises WearcapError for a missing one."""
    there = {path.relative_to(source).parts[0] for path in files}
    for name in subsets:
        if name not in there:
            raise WearcapError(f"no data set {name!r}", where=source, fix=nearest(name, there))
    return [path for path in files if path.relative_to(source).parts[0] in set(subsets)]
