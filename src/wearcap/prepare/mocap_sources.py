"""Motion capture without sensors: CMU's (ASF/AMC and BVH), any folder of BVH files, and AMASS (SMPL-H or SMPL-X files)."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.landmarks import head_level, with_head_face
from wearcap.errors import WearcapError, nearest
from wearcap.io.datasets.amass import read_amass
from wearcap.io.formats.asf_amc import read_amc, read_asf
from wearcap.io.formats.bvh import read_bvh, read_cmu_bvh
from wearcap.io.formats.text import read_text
from wearcap.prepare.engine import Splits, Task, content_hash, source_folder
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording, on_xsens23
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording

CMU_VERSION, AMASS_VERSION = 2, 1
"""Versions of the conversions, increased when the same source and settings yield another recording."""

MOTION_SUFFIXES = (".amc", ".amc.xz", ".amc.gz", ".bvh", ".bvh.xz", ".bvh.gz")
HEAD_TRIALS, HEAD_FRAME_STEP = 6, 12
"""Number of a subject's trials, and stride of their frames, from which the tilt of the head's markers is estimated."""

CGSPEED_JOINT = "LHipJoint"
"""Joint by which cgspeed's conversions of CMU are recognised."""

NO_MOTION = ("shape.npz", "stagei.npz")
"""Name suffixes of AMASS's files that hold no motion."""


@dataclass(frozen=True)
class BvhSettings:
    """Units and axes of BVH files other than CMU's, whose units and axes are known."""

    unit_m: float | int
    up: str
    forward: str


def _cmu_recording(
    file: Path,
    asf: Path | None,
    about: About,
    amc_fps: float | int,
    bvh: BvhSettings,
    settings: MocapSettings,
    same_subject: tuple[Path, ...] = (),
) -> Recording:
    """One file of motion, with its skeleton file where the format needs one.

    The tilt of the head's markers is estimated from `same_subject`, trials of the same subject and skeleton file. Raises
    WearcapError for an AMC file without a skeleton.
    """
    if ".amc" in file.name.lower():
        if asf is None:
            fix = "An AMC file needs its subject's .asf."
            expected = f"{file.name.split('_')[0]}.asf, or one .asf file"
            raise WearcapError("no skeleton beside it", where=file, fix=fix, expected=expected)
        motion = read_amc(read_asf(asf), file, amc_fps)
    elif CGSPEED_JOINT in read_text(file)[:4096]:
        motion = read_cmu_bvh(file)
    else:
        motion = read_bvh(file, unit_m=bvh.unit_m, up=bvh.up, forward=bvh.forward)
    motion = on_xsens23(motion)
    face = None if asf is None else _head_face(asf, same_subject, amc_fps)
    if face is not None:
        motion = replace(motion, R_parent_joint=with_head_face(motion.skeleton, motion.R_parent_joint, face))
    return mocap_recording(motion, about, settings)


@cache
def _head_face(asf: Path, files: tuple[Path, ...], fps: float | int) -> Float[Tensor, "3 3"] | None:
    """Tilt of a subject's face in the captured head frame: CMU's head markers sit 5…45° off, by subject."""
    skeleton, poses = read_asf(asf), []
    for file in files:
        try:
            motion = read_amc(skeleton, file, fps)
        except WearcapError:  # reported by the trial's own task
            continue
        thin = slice(None, None, HEAD_FRAME_STEP)
        R, t = motion.R_parent_joint[thin], motion.t_world_root[thin]
        motion = on_xsens23(Motion(motion.timestamps[thin], motion.skeleton, R, t))
        poses.append(motion.R_parent_joint)
    return head_level(motion.skeleton, torch.cat(poses)) if poses else None


def cmu_tasks(
    source: str | Path, splits: Splits, settings: MocapSettings, bvh: BvhSettings, amc_fps: float | int, license: str
) -> list[Task]:
    """One task per trial found anywhere below `source`.

    Files are named SUBJECT_TRIAL.amc or .bvh (also .xz, .gz); an .amc needs SUBJECT.asf in its folder. Where a
    trial exists as both, the AMC is taken. `index.csv` (columns trial, category) provides activities if it exists.
    """
    source = source_folder(source)
    index, activities = source / "index.csv", {}
    if index.is_file():
        with open(index, newline="", encoding="utf-8") as file:
            activities = {row["trial"]: row.get("category") for row in csv.DictReader(file) if row.get("trial")}
    trials: dict[str, tuple[Path, Path | None]] = {}  # motion file, and skeleton file of an AMC
    for path in sorted(p for p in source.rglob("*") if p.name.lower().endswith(MOTION_SUFFIXES)):
        name, asf = path.name.split(".")[0], None
        if name in trials and path.parent != trials[name][0].parent:
            raise WearcapError(f"two trials are called {name!r}: {trials[name][0]} and {path}", fix="Rename one.")
        if ".amc" in path.name.lower():  # its skeleton is its subject's .asf, else the only one in the folder
            skeletons = sorted(p for p in path.parent.iterdir() if p.name.lower().split(".")[1:2] == ["asf"])
            own = [p for p in skeletons if p.name.split(".")[0] == path.name.split("_")[0]]
            asf = (own or skeletons)[0] if len(own or skeletons) == 1 else None
        trials.setdefault(name, (path, asf))  # .amc comes first
    if not trials:
        raise WearcapError("no .amc or .bvh files", where=source, expected="motion files, plain or .xz or .gz")
    same: dict[tuple[str, Path | None], list[Path]] = {}
    for name, (path, asf) in trials.items():
        same.setdefault((_subject(name), asf), []).append(path)
    tasks = []
    for name, (path, asf) in trials.items():
        subject = _subject(name)
        about = About(name, subject, "cmu", license, activities.get(name) or "")
        others = same[subject, asf]
        spread = tuple(others[:: -(-len(others) // HEAD_TRIALS)]) if asf is not None else ()
        make = partial(_cmu_recording, path, asf, about, amc_fps, bvh, settings, spread)
        described = [asdict(about), asdict(settings), asdict(bvh), amc_fps, CMU_VERSION]
        sources = [path] if asf is None else [path, asf, *spread]
        tasks.append(Task(name, make, splits.of(subject), content_hash(*described, *sources)))
    return tasks


def _subject(name: str) -> str:
    """ "07" of "07_12" → "7"; a name without a subject's number is its own subject."""
    first = name.split("_")[0]
    return str(int(first)) if first.isdigit() and "_" in name else name


def _amass(file: Path, about: About, settings: MocapSettings) -> Recording:
    source = read_amass(file)
    assert source.motion is not None
    return replace(mocap_recording(source.motion, about, settings), shape=source.shape)


def amass_tasks(
    source: str | Path, splits: Splits, settings: MocapSettings, license: str, subsets: Sequence[str] | None = None
) -> list[Task]:
    """One task per motion file below `source`, laid out DATASET/SUBJECT/MOTION.npz, of all data sets or of `subsets`.

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
        key = content_hash(asdict(about), asdict(settings), AMASS_VERSION, path)
        split = splits.of(file if file in by_file else subject)
        tasks.append(Task(name, partial(_amass, path, about, settings), split, key))
    if not tasks:
        raise WearcapError("no motion files (.npz)", where=source, expected="AMASS as it unpacks")
    return tasks
