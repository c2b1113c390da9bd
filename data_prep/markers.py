"""Optical markers (TRC files; UI-PRMD is a config of it): a person's body from several trials, then the motion of each."""

import re
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path

from data_prep.shared.engine import NOTE, Splits, Task, source_folder
from data_prep.shared.mocap import About, MocapSettings, mocap_recording
from data_prep.ui_prmd import read_ui_prmd
from wearcap.boundary.opening import placed, understood
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.conventions import AUTO, Conventions
from wearcap.io.formats.trc import Markers, read_trc
from wearcap.optimize.markers import MARKERS, MarkerBody, fit_body, fit_motion, plug_in_gait
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the fit, increased when the same source and settings yield another recording."""


BODY_TRIALS = 24
"""Number of a person's trials from which bones and places of markers are estimated."""


LARGEST_RMS_M = 0.015
"""Root mean square of the markers' distances from the body above which a trial gets a note."""


def marker_tasks(
    source: str | Path,
    splits: Splits,
    settings: MocapSettings,
    license: str,
    files: str,
    origin: str,
    subject: str | None = None,
    activity: str | None = None,
    activities: dict[str, str] | None = None,
    unit: str | float | int = AUTO,
    up: str = AUTO,
) -> list[Task]:
    """One task per file below `source` whose name matches the pattern `files`, named by its path; a body per subject.

    `subject` and `activity` are each a regular expression with one group, searched in the path below `source`, or one name
    for all; `activities` may replace what the group finds. By default the subject is the folder, and there is no activity.
    """
    source, how = source_folder(source), Conventions(unit=unit, up=up)
    abouts, persons = dict[Path, About](), dict[str, list[Path]]()
    for path in sorted(source.rglob(files)):
        below = path.relative_to(source)
        name = "__".join([*below.parent.parts, path.name.split(".")[0]]).replace(" ", "_")
        folder = below.parent.as_posix() if below.parent.parts else source.resolve().name
        who, what = _found(below, "subject", subject) or folder, _found(below, "activity", activity)
        abouts[path] = About(name, who, origin, license, (activities or {}).get(what, what))
        persons.setdefault(who, []).append(path)
    if not abouts:
        raise WearcapError(f"no files {files}", where=source, expected="marker files, plain or .xz or .gz")
    spread = {who: tuple(paths[:: -(-len(paths) // BODY_TRIALS)]) for who, paths in persons.items()}
    digests = {who: content_hash(*paths, asdict(settings), asdict(how), VERSION) for who, paths in spread.items()}
    return [
        Task(
            about.name,
            partial(_recording, path, about, settings, how, spread[about.subject]),
            splits.of(about.subject),
            content_hash(asdict(about), digests[about.subject], path),
        )
        for path, about in abouts.items()
    ]


def _found(below: Path, what: str, rule: str | None) -> str:
    """A file's subject or activity by a rule: a pattern with one group, or the name itself."""
    if rule is None or "(" not in rule:
        return rule or ""
    with understood(
        f"{what}={rule}", below, "a pattern with a group, found in each path", errors=(re.error, LookupError)
    ):
        return re.compile(rule).findall(below.as_posix())[-1]


def _read(path: Path, how: Conventions) -> Markers:
    return read_trc(path, how) if ".trc" in path.name.lower() else read_ui_prmd(path)


@cache
def _body(files: tuple[Path, ...], how: Conventions) -> MarkerBody:
    """The body of a person, from the readable ones of several trials."""
    trials = []
    for file in files:
        with suppress(WearcapError):  # reported by the trial's own task
            trials.append(_read(file, how))
    return fit_body(trials)


def _recording(
    path: Path, about: About, settings: MocapSettings, how: Conventions, files: tuple[Path, ...]
) -> Recording:
    """One trial, fitted with its person's body; the provenance keeps how far the markers are from it."""
    markers = _read(path, how)
    with placed(path):
        body = _body(files, how)
        motion, distance = fit_motion(body, markers)
    rms, each = distance.square().nanmean().sqrt().item(), distance.square().nanmean(0).nan_to_num(0.0)
    unknown = [name for name in markers.names if plug_in_gait(name) not in MARKERS]
    notes = [f"markers left out, whose place is not known: {', '.join(unknown[:20])}"] if unknown else []
    if rms > LARGEST_RMS_M:
        notes.append(
            f"markers are {100 * rms:.1f} cm (rms) from the body, most of all {body.names[int(each.argmax())]}"
        )
    recording = mocap_recording(replace(motion, provenance={"markers_rms_m": f"{rms:.4f}"}), about, settings)
    assert recording.motion is not None
    known = recording.motion.provenance
    note = "; ".join([*notes, *([known[NOTE]] if NOTE in known else [])])
    return replace(recording, motion=replace(recording.motion, provenance=known | ({NOTE: note} if note else {})))
