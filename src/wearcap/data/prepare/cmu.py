"""CMU's motion capture (ASF/AMC and BVH), and any folder of BVH files."""

import csv
from dataclasses import asdict, dataclass
from pathlib import Path

from wearcap.data.prepare.engine import Task, content_hash
from wearcap.data.prepare.mocap import About, MocapSettings, mocap_recording
from wearcap.data.prepare.splits import Splits
from wearcap.errors import WearcapError
from wearcap.io.asf_amc import read_amc, read_asf
from wearcap.io.bvh import read_bvh, read_cmu_bvh
from wearcap.io.text import read_text
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording

VERSION = 1
"""Raised when the same source and settings would give another recording."""

MOTION_SUFFIXES = (".amc", ".amc.xz", ".amc.gz", ".bvh", ".bvh.xz", ".bvh.gz")
CGSPEED_JOINT = "LHipJoint"
"""A joint that only cgspeed's conversions of CMU have."""


@dataclass(frozen=True)
class BvhSettings:
    """Units and axes of BVH files other than CMU's (those are known)."""

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

    def __call__(self) -> Recording:
        return mocap_recording(self.read(), self.about, self.settings)

    def read(self) -> Motion:
        """The motion in the file's own skeleton."""
        if ".amc" in self.file.name.lower():
            if self.asf is None:
                raise WearcapError("no skeleton beside it", where=self.file, fix="An AMC file needs its subject's .asf.",
                                   expected=f"{self.file.name.split('_')[0]}.asf, or one .asf file")  # fmt: skip
            return read_amc(read_asf(self.asf), self.file, self.amc_fps)
        if _is_cgspeed(self.file):
            return read_cmu_bvh(self.file)
        return read_bvh(self.file, unit_m=self.bvh.unit_m, up=self.bvh.up, forward=self.bvh.forward)


def cmu_tasks(
    source: str | Path, splits: Splits, settings: MocapSettings, bvh: BvhSettings,
    amc_fps: float | int, license: str,
) -> list[Task]:  # fmt: skip
    """One task per trial found anywhere below `source`.

    Files are named SUBJECT_TRIAL.amc or .bvh (also .xz, .gz); an .amc needs SUBJECT.asf in its folder. Where a
    trial exists as both, the AMC is taken. `index.csv` (columns trial, category) gives activities when it is there.
    """
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    activities = _activities(source / "index.csv")
    tasks = []
    for name, path in _trials(source).items():
        subject = _subject(name)
        about = About(name, subject, "cmu", license, activities.get(name, ""))
        asf = _asf_for(path) if ".amc" in path.name.lower() else None
        trial = Trial(path, asf, about, amc_fps, bvh, settings)
        described = [asdict(about), asdict(settings), asdict(bvh), amc_fps, VERSION]
        sources = [path] if asf is None else [path, asf]
        tasks.append(Task(name, trial, splits.of(subject), content_hash(*described, *sources)))
    return tasks


def _trials(source: Path) -> dict[str, Path]:
    """Files of motion by trial; where a folder holds a trial in several forms, AMC goes before BVH."""
    files: dict[str, Path] = {}
    for path in sorted(p for p in source.rglob("*") if p.name.lower().endswith(MOTION_SUFFIXES)):
        name = path.name.split(".")[0]
        if name in files and path.parent != files[name].parent:
            raise WearcapError(f"two trials are called {name!r}: {files[name]} and {path}", fix="Rename one.")
        files.setdefault(name, path)
    if not files:
        raise WearcapError(
            "no .amc or .bvh files", where=source, expected="motion files, plain or .xz or .gz"
        )
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
            row["trial"]: row["category"]
            for row in csv.DictReader(file)
            if row.get("trial") and row.get("category")
        }


def _is_cgspeed(bvh: Path) -> bool:
    return CGSPEED_JOINT in read_text(bvh)[:4096]
