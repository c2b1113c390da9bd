"""AMASS: SMPL-H or SMPL-X files, laid out DATASET/SUBJECT/MOTION.npz."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from wearcap.errors import WearcapError, nearest
from wearcap.io.conventions import AUTO
from wearcap.io.formats.amass import read_amass
from wearcap.prepare.engine import Splits, Task, content_hash, source_folder
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording
from wearcap.recording.recording import Recording

VERSION = 3
"""Version of the conversion, increased when the same source and settings yield another recording."""
NO_MOTION = ("shape.npz", "stagei.npz")
"""Name suffixes of AMASS's files that hold no motion."""


def _amass(file: Path, about: About, settings: MocapSettings, up: str) -> Recording:
    source = read_amass(file, up)
    assert source.motion is not None
    return replace(mocap_recording(source.motion, about, settings), shape=source.shape, note=source.note)


def amass_tasks(
    source: str | Path,
    splits: Splits,
    settings: MocapSettings,
    license: str,
    subsets: Sequence[str] | None = None,
    up: str = AUTO,
) -> list[Task]:
    """One task per motion file below `source`, laid out DATASET/SUBJECT/MOTION.npz, of all data sets or of `subsets`;
    `up` is the axis that is up in all.

    A row of the split list that names a file (DATASET/SUBJECT/MOTION) takes precedence over its subject's. Raises
    WearcapError for a missing subset, and for a file that is not laid out so.
    """
    source = source_folder(source)
    files = sorted(path for path in source.rglob("*.npz") if not path.name.endswith(NO_MOTION))
    if subsets is not None:
        there = {path.relative_to(source).parts[0] for path in files}
        for name in subsets:
            if name not in there:
                raise WearcapError(f"no data set {name!r}", where=source, fix=nearest(name, there))
        files = [path for path in files if path.relative_to(source).parts[0] in set(subsets)]
    by_file = {row for row, _ in splits.rows if row.count("/") > 1}
    tasks = []
    for path in files:
        parts = path.relative_to(source).with_suffix("").parts
        if len(parts) < 3:
            expected = f"{source}/DATASET/SUBJECT/{path.name}"
            raise WearcapError("not below a data set's and a subject's folder", where=path, expected=expected)
        name, subject, file = "__".join(parts).replace(" ", "_"), "/".join(parts[:2]), "/".join(parts)
        about = About(name, subject, "amass", license)
        key = content_hash(asdict(about), asdict(settings), VERSION, up, path)
        split = splits.of(file if file in by_file else subject)
        tasks.append(Task(name, partial(_amass, path, about, settings, up), split, key))
    if not tasks:
        raise WearcapError("no motion files (.npz)", where=source, expected="AMASS as it unpacks")
    return tasks
