"""Optical markers to recordings (TRC files, UI-PRMD): a person's body from several trials, then the motion of each."""

import re
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path

from wearcap.boundary.opening import placed, understood
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO, DETECTED, Conventions
from wearcap.io.datasets.ui_prmd import read_ui_prmd, ui_prmd_trial
from wearcap.io.formats.trc import Markers, read_trc
from wearcap.optimize.markers import MARKERS, MarkerBody, fit_body, fit_motion, plug_in_gait
from wearcap.prepare.engine import NOTE, Splits, Task, content_hash, source_folder
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the fit, increased when the same source and settings yield another recording."""
BODY_TRIALS = 24
"""Number of a person's trials from which bones and places of markers are estimated."""
LARGEST_RMS_M = 0.015
"""Root mean square of the markers' distances from the body above which a trial gets a note."""
SUFFIXES = (".trc", ".trc.gz", ".trc.xz")


def marker_tasks(
    source: str | Path,
    splits: Splits,
    settings: MocapSettings,
    license: str,
    subject: str | None = None,
    activity: str | None = None,
    unit: str | float | int = AUTO,
    up: str = AUTO,
) -> list[Task]:
    """One task per .trc (also .xz, .gz) file below `source`, named by its path; a body is fitted per subject.

    `subject` and `activity` are each a regular expression with one group, searched in the path below `source`, or one name
    for all. By default the subject is the folder, and there is no activity.
    """
    source = source_folder(source)
    files = sorted(path for path in source.rglob("*") if path.name.lower().endswith(SUFFIXES))
    if not files:
        raise WearcapError("no .trc files", where=source, expected="marker files, plain or .xz or .gz")
    trials = {}
    for path in files:
        below = path.relative_to(source)
        name = "__".join([*below.parent.parts, re.sub(r"\.trc(\.[gx]z)?$", "", path.name, flags=re.I)]).replace(
            " ", "_"
        )
        if name in trials:
            raise WearcapError(f"two files are called {name!r}: {trials[name][0]} and {path}", fix="Rename one.")
        folder = below.parent.as_posix() if below.parent.parts else source.resolve().name
        who = folder if subject is None else _named(below, "subject", subject)
        about = About(name, who, "markers", license, "" if activity is None else _named(below, "activity", activity))
        trials[name] = path, about
    return _tasks(list(trials.values()), splits, settings, Conventions(unit=unit, up=up))


def ui_prmd_tasks(source: str | Path, splits: Splits, settings: MocapSettings, license: str) -> list[Task]:
    """One task per trial of UI-PRMD below `source`, the movement its activity; badly done repetitions (`_inc`), too."""
    trials = []
    for path in sorted(source_folder(source).rglob("m??_s??_e??*")):
        if found := ui_prmd_trial(path):
            name = path.name.split(".")[0].replace("_positions", "")
            trials.append((path, About(name, found[0], "ui_prmd", license, found[1])))
    if not trials:
        raise WearcapError(
            "no trials of UI-PRMD", source, "files such as m01_s01_e01_positions.txt or m01_s01_e01.d2.npy.xz"
        )
    return _tasks(trials, splits, settings, DETECTED)


def _named(below: Path, what: str, rule: str) -> str:
    """A file's subject or activity by a rule: a pattern with one group, or the name itself."""
    if "(" not in rule:
        return rule
    with understood(
        f"{what}={rule}",
        below,
        f"a pattern with one group that finds the {what}",
        errors=(re.error, TypeError, IndexError),
    ):
        return re.search(rule, below.as_posix())[1]  # pyright: ignore[reportOptionalSubscript]


def _tasks(trials: list[tuple[Path, About]], splits: Splits, settings: MocapSettings, how: Conventions) -> list[Task]:
    tasks, persons = [], {}
    for path, about in trials:
        persons.setdefault(about.subject, []).append(path)
    spread = {who: tuple(files[:: -(-len(files) // BODY_TRIALS)]) for who, files in persons.items()}
    digests = {who: content_hash(*files) for who, files in spread.items()}
    for path, about in trials:
        make = partial(_recording, path, about, settings, how, spread[about.subject])
        key = content_hash(asdict(about), asdict(settings), asdict(how), VERSION, digests[about.subject], path)
        tasks.append(Task(about.name, make, splits.of(about.subject), key))
    return tasks


def _read(path: Path, how: Conventions) -> Markers:
    return read_ui_prmd(path) if ui_prmd_trial(path) else read_trc(path, how)


@cache
def _body(files: tuple[Path, ...], how: Conventions) -> MarkerBody:
    """The body of a person, from the readable ones of several trials."""
    trials = []
    for file in files:
        with suppress(WearcapError):  # reported by the trial's own task
            trials.append(_read(file, how))
    with placed(files[0].parent):
        return fit_body(trials)


def _recording(
    path: Path, about: About, settings: MocapSettings, how: Conventions, files: tuple[Path, ...]
) -> Recording:
    """One trial, fitted with its person's body; the provenance keeps how far the markers are from it."""
    markers = _read(path, how)
    with placed(path):
        motion, distance = fit_motion(_body(files, how), markers)
    notes = []
    if unknown := [name for name in markers.names if plug_in_gait(name) not in MARKERS]:
        notes.append(f"markers left out, whose place is not known: {', '.join(unknown[:20])}")
    rms = distance.square().nanmean().sqrt().item()
    if rms > LARGEST_RMS_M:
        worst = _body(files, how).names[int(distance.square().nanmean(0).nan_to_num(0).argmax())]
        notes.append(f"markers are {100 * rms:.1f} cm (rms) from the body, worst of all {worst}")
    recording = mocap_recording(replace(motion, provenance={"markers_rms_m": f"{rms:.4f}"}), about, settings)
    assert recording.motion is not None
    known = recording.motion.provenance
    notes += [known[NOTE]] if NOTE in known else []
    known = known | ({NOTE: "; ".join(notes)} if notes else {})
    return replace(recording, motion=replace(recording.motion, provenance=known))
