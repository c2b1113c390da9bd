"""BVH or ASF/AMC files of any origin: names, unit, axes and rest pose are detected."""

import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import takewhile
from pathlib import Path

from torch import Tensor

from data_prep.shared.engine import NOTE, Splits, Task, source_folder
from data_prep.shared.hips import find_shift, with_shift
from data_prep.shared.mocap import MOCAP, About, MocapSettings, mocap_recording
from wearcap.boundary.texts import numbered_lines
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.conventions import AUTO, Conventions
from wearcap.prepare.foreign import read_foreign_motion, straightest
from wearcap.prepare.foreign_conventions import Mapping, read_mapping
from wearcap.prepare.foreign_files import Take, asf_beside
from wearcap.prepare.levels import Levels, levels_in
from wearcap.recording.recording import Recording

VERSION = 3
"""Version of the conversion, increased when the same source and settings yield another recording."""


MOTION_SUFFIXES = (".amc", ".amc.xz", ".amc.gz", ".bvh", ".bvh.xz", ".bvh.gz")


SUBJECT_TRIALS = 24
"""Number of a subject's trials, spread over all, that show what is constant of them: axes, levels, hip joints."""


@dataclass(frozen=True)
class Hips:
    """Whether and from where a person's hip joints are moved (`data_prep.shared.hips`)."""

    repair: bool
    usual_m: Sequence[float]
    """Usual shift ahead and up (m), which is taken for people who neither walk nor stand."""


def _foreign_recording(
    file: Path,
    asf: Path | None,
    about: About,
    amc_fps: float | int,
    mapping: Mapping,
    settings: MocapSettings,
    hips: Hips,
    same_subject: tuple[Path, ...] = (),
) -> Recording:
    """One file of motion, fitted to its joints; what was detected is kept in the motion's provenance as `conventions`.

    The tilts of head and feet, a BVH file's axes and the hips' places are estimated from `same_subject`, trials of the
    same subject. Raises WearcapError for an AMC file without a skeleton.
    """
    given = tuple(mapping.joints.items()), mapping.unit_m, mapping.up, mapping.forward
    levels, siblings, shift = _of_subject(same_subject, asf, amc_fps, given, hips.repair and tuple(hips.usual_m))
    read = read_foreign_motion(file, mapping, amc_fps=amc_fps, asf=asf, levels=levels, siblings=siblings)
    recording = mocap_recording(read.motion if shift is None else with_shift(read.motion, shift), about, settings)
    assert recording.motion is not None
    known = recording.motion.provenance
    notes = [known[NOTE]] if NOTE in known else []
    notes += [read.report.summary()] if about.source != "cmu" else []
    found = {"conventions": " ".join(read.report.lines())} | ({NOTE: "; ".join(notes)} if notes else {})
    return replace(recording, motion=replace(recording.motion, provenance=known | found))


@cache
def _of_subject(
    files: tuple[Path, ...], asf: Path | None, amc_fps: float | int, given: tuple, usual_m: tuple[float, ...] | bool
) -> tuple[Levels | None, tuple[Take, ...], Tensor | None]:
    """What is constant of a subject: tilts of head and feet (of AMC), straight clips (of BVH), shift of the hips.

    CMU's head markers sit 5…45° off, by subject. Files that cannot be read are left out.
    """
    mapping = Mapping(dict(given[0]), *given[1:])
    siblings = straightest(files, given[0]) if asf is None and files[1:] else ()
    motions = []
    for file in files if asf is not None or usual_m else ():
        with suppress(WearcapError):  # reported by the trial's own task
            levels = None if asf is None else Levels(None, {})
            read = read_foreign_motion(file, mapping, amc_fps=amc_fps, asf=asf, levels=levels, siblings=siblings)
            motions.append(read.motion)
    levels = levels_in(motions) if motions and asf is not None else None
    if not motions or not isinstance(usual_m, tuple):
        return levels, siblings, None
    return levels, siblings, find_shift(motions, usual_m, levels and levels.R_pelvis)


VARIANTS = {
    "accad": {
        "about": "ACCAD motion capture (BVH, plain, .xz or .gz), in files that are named PERSON_ACTION.",
        "subject": r"([A-Za-z]+\d+)_",
        "activity": r"_([A-Za-z]{3,})",
        "repair": True,
        "usual_m": (0.0, 0.012),
        "license": "CC BY 3.0; motion capture data: Advanced Computing Center for the Arts and Design (ACCAD), The Ohio "
        "State University.",
    },
    "berkeley_mhad": {
        "about": "Berkeley MHAD's skeletons (BVH, plain, .xz or .gz), in files that are named skl_PERSON_ACTION_REPETITION.",
        "subject": r"skl_(s\d+)_",
        "activity": r"skl_s\d+_([a-z0-9]+)",
        "repair": True,
        "license": "Copyright (c) 2013, The Regents of the University of California. Read the terms on the data set's page "
        "before sharing what is trained on it.",
    },
    "fubot_vr": {
        "about": "FuBoT-VR: one person in an inertial suit who plays VR games (BVH, plain, .xz or .gz), in files named "
        "GAME_NUMBER. The split is by game.",
        "subject": r"([a-z]+)_\d+",
        "activity": r"([a-z]+)_\d+",
        "license": "MIT; FuBoT-VR data set, Tomiha, github.com/Tomiha/FuBoT-VR-Dataset.",
    },
    "hdm05": {
        "about": "HDM05 motion capture (ASF/AMC), plain, .xz or .gz, cut into clips named HDM_PERSON_ACTION_NUMBER_120.",
        "subject": r"HDM_([a-z]+)_",
        "activity": r"HDM_[a-z]+_([A-Za-z]+)",
        "repair": True,
        "usual_m": (-0.012, 0.013),
        "license": "CC BY-SA 3.0; the data used in this project was obtained from HDM05 (M. Müller, T. Röder, M. Clausen, "
        "B. Eberhardt, B. Krüger, A. Weber: Documentation Mocap Database HDM05, Universität Bonn, CG-2007-2, 2007).",
    },
}
"""Data sets in these formats: what they are, and settings that have other defaults."""


def bvh_tasks(
    source: str | Path,  # a file, or a folder (searched as deep as it goes)
    splits: Splits,
    settings: MocapSettings = MOCAP,
    amc_fps: float | int = 120,  # not in AMC files
    license: str = "unknown",  # kept in every recording: say whose data it is
    repair: bool = False,  # true moves the hip joints so that knees straighten as people's do, per person
    # the hips' usual shift ahead and up (m), for people who neither walk nor stand
    usual_m: Sequence[float] = (0.0, 0.0),
    mapping: str | Path | None = None,  # a YAML file that overrides what is detected: joints, unit, up, forward
    # null: the number in SUBJECT_TRIAL, else the folder; or a pattern with one group, folder, a name
    subject: str | None = None,
    activity: str | None = None,  # null: none; or a pattern with one group, folder, a name
    unit: str | float | int = AUTO,  # of length: m, cm, mm, inch …, or metres per unit
    up: str = AUTO,  # the axis that is up: x, y, z, -x, -y, -z
) -> list[Task]:
    """One task per .bvh or .amc (also .xz, .gz) that `source` is or that lies anywhere below it, named by its path.

    `mapping`, a YAML file, overrides what is detected of all files' conventions, as `unit` and `up` do. `subject` and
    `activity` are each a regular expression with one group, searched in the path below `source`; or "folder"; or one name
    for all. By default the subject is the number of CMU's SUBJECT_TRIAL names, else the folder, and there is no activity.
    """
    source = Path(source)
    if source.is_file() and not source.name.lower().endswith(MOTION_SUFFIXES):
        raise WearcapError("no motion file", source, f"a name that ends in {', '.join(MOTION_SUFFIXES)}")
    files = [source] if source.is_file() else motion_files(source_folder(source))
    root = source.parent if source.is_file() else source
    trials: dict[str, Path] = {}
    for path in files:
        name = "__".join([*path.relative_to(root).parent.parts, stem_of(path)]).replace(" ", "_")
        if name in trials and (trials[name].parent, stem_of(trials[name])) != (path.parent, stem_of(path)):
            raise WearcapError(f"two files are called {name!r}: {trials[name]} and {path}", fix="Rename one.")
        trials.setdefault(name, path)  # .amc comes first
    subjects = subjects_of(root, trials, subject)
    activities = {
        name: "" if activity is None else _named(path, root, "activity", activity) for name, path in trials.items()
    }
    abouts = {name: About(name, subjects[name], "bvh", license, activities[name]) for name in trials}
    given, how = Mapping() if mapping is None else read_mapping(mapping), Conventions(unit=unit, up=up)
    given = replace(given, unit_m=how.unit_m or given.unit_m, up=given.up if how.up == AUTO else how.up)
    return motion_tasks(trials, abouts, splits, settings, amc_fps, given, Hips(repair, usual_m), VERSION)


def motion_files(source: Path) -> list[Path]:
    """Motion files anywhere below a folder, a trial's .amc before its .bvh. Raises WearcapError when there are none."""
    files = sorted(p for p in source.rglob("*") if p.name.lower().endswith(MOTION_SUFFIXES))
    if not files:
        raise WearcapError("no .amc or .bvh files", where=source, expected="motion files, plain or .xz or .gz")
    return files


def stem_of(path: Path) -> str:
    """A motion file's name without the endings of its format."""
    ending = next(ending for ending in sorted(MOTION_SUFFIXES, key=len)[::-1] if path.name.lower().endswith(ending))
    return path.name[: -len(ending)]


def motion_tasks(
    trials: dict[str, Path],
    abouts: dict[str, About],
    splits: Splits,
    settings: MocapSettings,
    amc_fps: float | int,
    mapping: Mapping,
    hips: Hips,
    version: int,
) -> list[Task]:
    groups, skeletons = dict[str, tuple[str, str]](), dict[str, Path | None]()
    same: dict[tuple[str, str], list[Path]] = {}
    for name, path in trials.items():
        asf, digest = None, ""
        with suppress(WearcapError):  # raised again by the trial's own task
            asf = asf_beside(path) if ".amc" in path.name.lower() else None
            digest = _hierarchy(path) if asf is None else content_hash(asf)
        groups[name], skeletons[name] = (abouts[name].subject, digest), asf
        same.setdefault(groups[name], []).append(path)
    spread = {group: tuple(files[:: -(-len(files) // SUBJECT_TRIALS)]) for group, files in same.items()}
    digests = {group: content_hash(*files) for group, files in spread.items()}
    tasks = []
    for name, path in trials.items():
        about, asf = abouts[name], skeletons[name]
        make = partial(_foreign_recording, path, asf, about, amc_fps, mapping, settings, hips, spread[groups[name]])
        described = [
            asdict(about),
            asdict(settings),
            asdict(mapping),
            asdict(hips),
            amc_fps,
            version,
            digests[groups[name]],
        ]
        sources = [path] if asf is None else [path, asf]
        tasks.append(Task(name, make, splits.of(about.subject), content_hash(*described, *sources)))
    return tasks


def _hierarchy(path: Path) -> str:
    """Digest of a BVH file's joints and OFFSETs but for the root's place: equal for clips of one skeleton."""
    lines = takewhile(lambda line: line.upper() != "MOTION", (line.strip() for _, line in numbered_lines(path)))
    return content_hash("\n".join(lines).partition("CHANNELS")[2])


def subjects_of(source: Path, trials: dict[str, Path], subject: str | None) -> dict[str, str]:
    """The subject of each trial by the rule `subject`; a warning says when each trial is a subject of its own."""
    found = {name: _subject(path, source, subject) for name, path in trials.items()}
    if len(set(found.values())) == len(found) > 1:
        name, path = next(iter(trials.items()))
        warnings.warn(
            f"each of the {len(found)} files is a subject of its own ({path.name}: {found[name]!r}), so that one person "
            "may be in training and in test: give subject=PATTERN with one group, subject=folder or subject=NAME",
            stacklevel=3,
        )
    return found


def _subject(path: Path, source: Path, rule: str | None) -> str:
    if rule is not None:
        return _named(path, source, "subject", rule)
    number = path.name.split("_")[0]
    return str(int(number)) if number.isdecimal() and "_" in path.name else _folder(path, source)


def _folder(path: Path, source: Path) -> str:
    below = path.relative_to(source).parent
    return below.as_posix() if below.parts else source.resolve().name


def _named(path: Path, source: Path, what: str, rule: str) -> str:
    """A file's subject or activity by a rule: a pattern with one group, "folder", or the name itself."""
    if rule == "folder" or "(" not in rule:
        return _folder(path, source) if rule == "folder" else rule
    try:
        pattern = re.compile(rule)
    except re.error as error:
        raise WearcapError(f"{what}={rule}: {error}", expected="a regular expression with one group") from error
    if pattern.groups != 1:
        raise WearcapError(f"{what}={rule} has {pattern.groups} groups", expected=f"one group, around the {what}")
    below = path.relative_to(source).as_posix()
    match = pattern.search(below)
    if not (match and match[1]):
        expected = f"a pattern that finds the {what} in each path"
        raise WearcapError(f"{what}={rule} does not match {below}", where=source, expected=expected)
    return match[1]
