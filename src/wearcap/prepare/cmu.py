"""CMU's motion capture (ASF/AMC and BVH), and any folder of BVH files."""

import csv
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.landmarks import head_level, with_head_face
from wearcap.errors import WearcapError
from wearcap.io.formats.asf_amc import read_amc, read_asf
from wearcap.io.formats.bvh import read_bvh, read_cmu_bvh
from wearcap.io.formats.text import read_text
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording, on_xsens23
from wearcap.prepare.splits import Splits
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""

MOTION_SUFFIXES = (".amc", ".amc.xz", ".amc.gz", ".bvh", ".bvh.xz", ".bvh.gz")
HEAD_TRIALS, HEAD_FRAME_STEP = 6, 12
"""Number of a subject's trials, and stride of their frames, from which the tilt of the head's markers is estimated."""

CGSPEED_JOINT = "LHipJoint"
"""Joint by which cgspeed's conversions of CMU are recognised."""


@dataclass(frozen=True)
class BvhSettings:
    """Units and axes of BVH files other than CMU's, whose units and axes are known."""

    unit_m: float | int
    up: str
    forward: str


@dataclass(frozen=True)
class Trial:
    """One file of motion, with its skeleton file where the format needs one; picklable, callable as a task."""

    file: Path
    asf: Path | None
    about: About
    amc_fps: float | int
    bvh: BvhSettings
    settings: MocapSettings
    same_subject: tuple[Path, ...] = ()
    """Trials of the same subject and skeleton file from which the tilt of the head's markers is estimated."""

    def __call__(self) -> Recording:
        motion = on_xsens23(self.read())
        if self.asf is not None:
            face = _head_face(self.asf, self.same_subject, self.amc_fps)
            if face is not None:
                R = with_head_face(motion.skeleton, motion.R_parent_joint, face)
                motion = replace(motion, R_parent_joint=R)
        return mocap_recording(motion, self.about, self.settings)

    def read(self) -> Motion:
        """The motion in the file's own skeleton."""
        if ".amc" in self.file.name.lower():
            if self.asf is None:
                raise WearcapError(
                    "no skeleton beside it",
                    where=self.file,
                    fix="An AMC file needs its subject's .asf.",
                    expected=f"{self.file.name.split('_')[0]}.asf, or one .asf file",
                )
            return read_amc(read_asf(self.asf), self.file, self.amc_fps)
        if _is_cgspeed(self.file):
            return read_cmu_bvh(self.file)
        return read_bvh(self.file, unit_m=self.bvh.unit_m, up=self.bvh.up, forward=self.bvh.forward)


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
        motion = on_xsens23(
            replace(
                motion,
                timestamps=motion.timestamps[thin],
                R_parent_joint=motion.R_parent_joint[thin],
                t_world_root=motion.t_world_root[thin],
                contact_prob=None,
            )
        )
        poses.append(motion.R_parent_joint)
    return head_level(motion.skeleton, torch.cat(poses)) if poses else None


def cmu_tasks(
    source: str | Path, splits: Splits, settings: MocapSettings, bvh: BvhSettings, amc_fps: float | int, license: str
) -> list[Task]:
    """One task per trial found anywhere below `source`.

    Files are named SUBJECT_TRIAL.amc or .bvh (also .xz, .gz); an .amc needs SUBJECT.asf in its folder. Where a
    trial exists as both, the AMC is taken. `index.csv` (columns trial, category) provides activities if it exists.
    """
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    activities = _activities(source / "index.csv")
    trials = {
        name: (path, _asf_for(path) if ".amc" in path.name.lower() else None) for name, path in _trials(source).items()
    }
    same: dict[tuple[str, Path | None], list[Path]] = {}
    for name, (path, asf) in trials.items():
        same.setdefault((_subject(name), asf), []).append(path)
    tasks = []
    for name, (path, asf) in trials.items():
        subject = _subject(name)
        about = About(name, subject, "cmu", license, activities.get(name, ""))
        others = same[subject, asf]
        spread = tuple(others[:: -(-len(others) // HEAD_TRIALS)]) if asf is not None else ()
        trial = Trial(path, asf, about, amc_fps, bvh, settings, spread)
        described = [asdict(about), asdict(settings), asdict(bvh), amc_fps, VERSION]
        sources = [path] if asf is None else [path, asf, *spread]
        tasks.append(Task(name, trial, splits.of(subject), content_hash(*described, *sources)))
    return tasks


def _trials(source: Path) -> dict[str, Path]:
    """Motion files by trial; if a folder has a trial in several formats, AMC takes precedence over BVH."""
    files: dict[str, Path] = {}
    for path in sorted(p for p in source.rglob("*") if p.name.lower().endswith(MOTION_SUFFIXES)):
        name = path.name.split(".")[0]
        if name in files and path.parent != files[name].parent:
            raise WearcapError(f"two trials are called {name!r}: {files[name]} and {path}", fix="Rename one.")
        files.setdefault(name, path)
    if not files:
        raise WearcapError("no .amc or .bvh files", where=source, expected="motion files, plain or .xz or .gz")
    return files


def _subject(name: str) -> str:
    """ "07" of "07_12" → "7"; a name without a subject's number is its own subject."""
    first = name.split("_")[0]
    return str(int(first)) if first.isdigit() and "_" in name else name


def _asf_for(amc: Path) -> Path | None:
    """The skeleton of an AMC file: its subject's, else the only one in the folder."""
    skeletons = sorted(p for p in amc.parent.iterdir() if p.name.lower().split(".")[1:2] == ["asf"])
    own = [p for p in skeletons if p.name.split(".")[0] == amc.name.split("_")[0]]
    return (own or skeletons)[0] if len(own or skeletons) == 1 else None


def _activities(index: Path) -> dict[str, str]:
    if not index.is_file():
        return {}
    with open(index, newline="", encoding="utf-8") as file:
        return {
            row["trial"]: row["category"] for row in csv.DictReader(file) if row.get("trial") and row.get("category")
        }


def _is_cgspeed(bvh: Path) -> bool:
    return CGSPEED_JOINT in read_text(bvh)[:4096]
