"""Captured motions of one recording, by the names under which they are shown."""

from collections.abc import Sequence
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording.motion import Motion

RESERVED = ("truth", "over", "beside")
"""Names that the page and the pictures use for other purposes."""


def read_motions(paths: Sequence[str]) -> dict[str, Motion]:
    """Motions by name: a single file is "capture"; several have their file names, prefixed by folders if these agree.

    Raises WearcapError for a file that is given twice, and as `read_motion` does.
    """
    if len(paths) == 1:
        return {"capture": read_motion(paths[0])}
    files = [Path(path).resolve() for path in paths]
    labels = [file.stem for file in files]
    if len(set(labels)) < len(labels) or set(labels) & set(RESERVED):
        labels = [f"{file.parent.name} {file.stem}" for file in files]
    if len(set(labels)) < len(labels):
        labels = [str(file).replace("/", " ").strip() for file in files]
    if len(set(labels)) < len(labels):
        raise WearcapError("a motion is given twice", where=", ".join(paths), expected="each file once")
    return {label: read_motion(file) for label, file in zip(labels, files, strict=True)}
