"""Examine everything in a path: data sets, files, folders of devices and data sets, scenes, environments, motion capture."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from wearcap.checks.consistency import check_files
from wearcap.checks.examine import examine_recording, is_empty
from wearcap.checks.report import Finding, Report, has_error, refusal
from wearcap.checks.truth import of_person, people
from wearcap.errors import WearcapError
from wearcap.io.conventions import DETECTED, Conventions
from wearcap.io.datasets.hps import hps_names, read_hps_sequence
from wearcap.reading.any_file import FILES, FOLDERS, MOTIONS, kind_of, load, unknown_kind
from wearcap.reading.kits import Loaded, log_files
from wearcap.recording import Recording, RecordingStore
from wearcap.recording.store import MANIFEST


def examine(
    source: Recording | str | Path,
    progress: Callable[[int, int], None] | None = None,
    preflight: Callable[[Recording, Path | None], list[Finding]] | None = None,
    how: Conventions = DETECTED,
) -> Report:
    """Examine a recording, or all in a data set, recording file, MPS folder, motion capture file or folder of them.

    Of a data set its people are reported, too, by the recordings without errors.
    Unreadable files are errors in the report; `progress(done, all)` is called after each recording. `preflight` adds
    findings on a recording and the folder of its files.
    Raises WearcapError when there is nothing to examine.
    """
    if isinstance(source, Recording):
        return Report(source.name, {source.name: tuple(examine_recording(source))})
    found = _patients(Path(source), how)
    findings: dict[str, tuple[Finding, ...]] = {}
    for done, (name, load_one) in enumerate(found.items(), 1):
        try:
            recording, read = load_one()
        except WearcapError as error:
            findings[name] = (refusal(error),)
        else:
            if preflight is not None:
                read = [*read, *preflight(recording, _folder_of(Path(source)))]
            findings[name] = tuple(read if read and is_empty(recording) else [*read, *examine_recording(recording)])
        if progress:
            progress(done, len(found))
    store = RecordingStore(source)
    figures = people(
        store, [name for name, found in findings.items() if name in store.entries and not has_error(found)]
    )
    findings |= {f"person {subject}": tuple(of_person(person)) for subject, person in figures.items()}
    return Report(str(source), findings, figures)


def _patients(path: Path, how: Conventions) -> dict[str, Callable[[], Loaded]]:
    """What loads each recording in a path, by name. Raises WearcapError when there is nothing to examine."""
    if not path.exists() and not (path.parent / MANIFEST).is_file():
        raise WearcapError("no such file or folder", where=path)
    if (path / MANIFEST).is_file():
        return {name: partial(load, path / name, how) for name in RecordingStore.open(path).names()}
    if not path.is_dir():
        if path.exists() and kind_of(path) is None:
            raise unknown_kind(path)
        return {path.name: partial(load, path, how)}
    if any(is_kind(path) for is_kind, _ in FOLDERS):
        return {path.resolve().name: partial(load, path, how)}
    if names := hps_names(path):
        return {name: partial(_load_hps, path, name) for name in names}
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and kind_of(file) in MOTIONS]
    files = files or list(log_files(path))
    if not files:
        raise WearcapError(
            "nothing to examine here",
            where=path,
            expected=f"a data set (manifest.json), an MPS, Nymeria, ADT, TotalCapture or HPS folder, a scene (pointcloud.ply, photos.json), an environment (environment.json), logs of watches, headsets or trajectories, or files like {', '.join(FILES)}",
        )
    return {file.relative_to(path).as_posix(): partial(load, file, how) for file in files}


def _load_hps(root: Path, name: str) -> Loaded:
    recording = read_hps_sequence(root, name)
    return Loaded(recording, check_files(recording, root))


def _folder_of(path: Path) -> Path | None:
    """Folder of the files that recordings at a path name: that of their data set."""
    if path.is_dir():
        return path
    return path.parent if path.parent.is_dir() else None
