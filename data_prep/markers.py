"""Optical markers in TRC files, named as in Vicon's Plug-in Gait: a body per person, then its motion."""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path

from data_prep.marker_fit import MARKERS, MarkerBody, fit_body, fit_motion, plug_in_gait
from data_prep.shared.engine import NOTE, Splits, Task, source_folder
from data_prep.shared.mocap import MOCAP, About, MocapSettings, mocap_recording
from wearcap.boundary.opening import placed, understood
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.conventions import AUTO, Conventions
from wearcap.io.formats.trc import Markers, read_trc
from wearcap.recording.recording import Recording

VERSION = 1
"""Version of the fit, increased when the same source and settings yield another recording."""


Read = Callable[[Path, Conventions], Markers]
"""Reader of a file."""
BODY_TRIALS = 24
"""Number of a person's trials from which bones and places of markers are estimated."""


LARGEST_RMS_M = 0.015
"""Root mean square of the markers' distances from the body above which a trial gets a note."""


def markers_tasks(
    source: str | Path,  # the folder with the .trc files (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = "unknown",  # kept in every recording: say whose data it is
    files: str = "*.trc*",  # their names
    subject: str | None = None,  # null: the folder; or a pattern with one group, a name
    activity: str | None = None,  # null: none; or a pattern with one group, a name
    unit: str | float | int = AUTO,  # of length: what the file says; or m, cm, mm, inch …, or metres per unit
    up: str = AUTO,  # the axis that is up: x, y, z; auto is y
) -> list[Task]:
    """One task per file below `source` whose name matches the pattern `files`, named by its path; a body per subject.

    `subject` and `activity` are each a regular expression with one group, searched in the path below `source`, or one name
    for all. By default the subject is the folder, and there is no activity.
    """
    how = Conventions(unit=unit, up=up)
    return marker_tasks("markers", source, splits, settings, license, files, (subject, activity), {}, how, read_trc)


def marker_tasks(
    origin: str,
    source: str | Path,
    splits: Splits,
    settings: MocapSettings,
    license: str,
    files: str,
    rules: tuple[str | None, str | None],
    activities: dict[str, str],
    how: Conventions,
    read: Read,
) -> list[Task]:
    """The same of files that `read` reads, of the data set `origin`; `rules` are of subject and activity, and `activities`
    may replace what the latter finds."""
    source = source_folder(source)
    abouts, persons = dict[Path, About](), dict[str, list[Path]]()
    for path in sorted(source.rglob(files)):
        below = path.relative_to(source)
        name = "__".join([*below.parent.parts, path.name.split(".")[0]]).replace(" ", "_")
        folder = below.parent.as_posix() if below.parent.parts else source.resolve().name
        who, what = _found(below, "subject", rules[0]) or folder, _found(below, "activity", rules[1])
        abouts[path] = About(name, who, origin, license, activities.get(what, what))
        persons.setdefault(who, []).append(path)
    if not abouts:
        raise WearcapError(f"no files {files}", where=source, expected="marker files, plain or .xz or .gz")
    spread = {who: tuple(paths[:: -(-len(paths) // BODY_TRIALS)]) for who, paths in persons.items()}
    digests = {who: content_hash(*paths, asdict(settings), asdict(how), VERSION) for who, paths in spread.items()}
    return [
        Task(
            about.name,
            partial(_recording, path, about, settings, how, read, spread[about.subject]),
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


@cache
def _body(files: tuple[Path, ...], how: Conventions, read: Read) -> MarkerBody:
    """The body of a person, from the readable ones of several trials."""
    trials = []
    for file in files:
        with suppress(WearcapError):  # reported by the trial's own task
            trials.append(read(file, how))
    return fit_body(trials)


def _recording(
    path: Path, about: About, settings: MocapSettings, how: Conventions, read: Read, files: tuple[Path, ...]
) -> Recording:
    """One trial, fitted with its person's body; the provenance keeps how far the markers are from it."""
    markers = read(path, how)
    with placed(path):
        body = _body(files, how, read)
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
