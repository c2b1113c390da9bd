"""Examine everything in a path: data sets, files, folders of devices and data sets, scenes, environments, motion capture."""

from collections.abc import Callable
from pathlib import Path

from wearcap.checks.examine import examine_recording, is_empty
from wearcap.checks.report import Finding, Report, has_error, refusal
from wearcap.checks.truth import of_person, people
from wearcap.errors import WearcapError
from wearcap.io.conventions import DETECTED, Conventions
from wearcap.reading.any_file import sources
from wearcap.recording import Recording, RecordingStore


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
    found = sources(Path(source), how)
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


def _folder_of(path: Path) -> Path | None:
    """Folder of the files that recordings at a path name: that of their data set."""
    if path.is_dir():
        return path
    return path.parent if path.parent.is_dir() else None
