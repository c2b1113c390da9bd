"""AMASS as it unpacks (DATASET/SUBJECT/MOTION.npz), SMPL-H or SMPL-X; bring your own download.

Random splits of its data sets were never published as lists: splits=FILE takes rows of subjects (CMU/14) and of files
(CMU/14/14_01_poses)."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from data_prep.shared.engine import Splits, Task, source_folder
from data_prep.shared.mocap import MOCAP, About, MocapSettings, mocap_recording
from wearcap.errors import WearcapError, nearest
from wearcap.files import content_hash
from wearcap.io.conventions import AUTO
from wearcap.io.formats.amass import read_amass
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
    source: str | Path,  # the folder that holds the data sets' folders
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = "AMASS licence (amass.is.tue.mpg.de); not to be passed on",
    # data sets' folders: MocapEvery's are [CMU, MPI_HDM05, BMLmovi], protocol 1's [BioMotionLab_NTroje, CMU,
    # MPI_HDM05]; null: all
    subsets: Sequence[str] | None = None,
    up: str = AUTO,  # the axis that is up: z as in AMASS, or where somebody clearly stands along another; x, y, z, -x …
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
