"""Resolves a recording given by the user, and the folder of its data set."""

from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore


def load_recording(where: str | Path) -> Recording:
    """Load "DATASET/NAME", a recording's .safetensors file, or a data set that holds just one recording.

    Raises WearcapError that names the choices when there is no such recording.
    """
    path = Path(where)
    if path.is_file():
        return RecordingFile(path).load()
    if (path / "manifest.json").is_file():
        names = RecordingStore.open(path).names()
        if len(names) == 1:
            return RecordingStore.open(path).load(names[0])
        raise WearcapError(
            f"a data set of {len(names)} recordings",
            where=path,
            expected=f"one of them, such as {path / names[0] if names else path / 'NAME'}",
        )
    if (path.parent / "manifest.json").is_file():
        return RecordingStore.open(path.parent).load(path.name)
    raise WearcapError(
        "no recording here", where=path, expected="DATASET/NAME or a .safetensors file that `wearcap prepare` wrote"
    )


def dataset_folder(where: str | Path) -> Path:
    """Folder of the data set of a recording given by the user; file names in the recording are relative to it."""
    path = Path(where)
    for folder in (path, *path.parents):
        if (folder / "manifest.json").is_file():
            return folder
    return path.parent
