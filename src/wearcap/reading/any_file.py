"""The one table of what holds a recording: `read(path)` returns the Recording, `load(path)` also what its reader found.

`capture`, `evaluate`, `live`, `view`, `prepare` and the doctor know files and folders by this table: by suffix, then by content.
"""

from collections.abc import Callable
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path

import torch

from wearcap.boundary.arrays import read_npz
from wearcap.boundary.opening import placed, understood
from wearcap.checks.consistency import check_files
from wearcap.checks.examine import require_sound
from wearcap.checks.places import is_map, is_place, read_environment_file, read_map, read_place
from wearcap.checks.report import Check
from wearcap.errors import WearcapError
from wearcap.io.conventions import CHOICES, DETECTED, Conventions
from wearcap.io.devices.aria_mps import is_mps_folder
from wearcap.io.devices.headset_log import is_headset_session
from wearcap.io.formats.amass import read_amass
from wearcap.io.formats.c3d_markers import read_markers
from wearcap.io.formats.motion_npz import motion_files, read_motion, read_sections
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.trajectory import trajectory_file, trajectory_format
from wearcap.optimize.markers import fit_body, fit_motion, fit_notes, rms_m
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.prepare.suits import read_suit
from wearcap.reading.kinds import Kind, Loaded, known
from wearcap.reading.kits import (
    LOGS,
    OF_HEADSETS,
    OF_TRAJECTORIES,
    is_kit,
    load_headset,
    load_kit,
    load_mps,
    load_trajectory,
    log_files,
)
from wearcap.recording import PointCloud, Recording, RecordingStore
from wearcap.recording.store import MANIFEST, RecordingFile, load_recording


def read(where: str | Path, how: Conventions = DETECTED, check: bool = False) -> Recording:
    """Read a recording from whatever holds one.

    That is a prepared recording (DATASET/NAME or its .safetensors), MVNX, BVH, AMC with its ASF, markers (C3D, TRC), AMASS or SMPL .npz, our
    motion .npz, a trajectory, a watch's or a headset's log, or a folder of Aria MPS, Nymeria, Aria Digital Twin or
    TotalCapture, or of one session's logs. A suit without foot contacts gets those of its feet's speed. Names are those of
    the files. Raises WearcapError for what cannot be read, and with `check` for what the doctor calls an error.
    """
    loaded = load(where, how)
    if check:
        require_sound(loaded.recording, loaded.findings)
    return loaded.recording


def load(where: str | Path, how: Conventions = DETECTED) -> Loaded:
    """As `read`, with the findings of the reader; also points, places and maps, which are no recordings of a wearer."""
    path = Path(where)
    if not path.exists() or (path / MANIFEST).is_file():
        return _load_stored(path)
    kind = kind_of(path)
    if kind is None or kind.parts:
        return Loaded(load_recording(path), [])
    return kind.load(path, how)


@cache
def kinds() -> tuple[Kind, ...]:
    """All kinds: those of data sets, which packages register as their entry points `wearcap.readers`, then wearcap's own."""
    return (*(kind for entry in entry_points(group="wearcap.readers") for kind in entry.load()), *KINDS)


def kind_of(path: Path) -> Kind | None:
    """Kind of a folder, None for one that is none; or of a file: of several with its suffix by content, and where none knows
    it the last one, whose reader says what is wrong. Raises WearcapError for another suffix."""
    if path.is_dir():
        return known(path, kinds())
    possible = possible_kinds(path)
    return known(path, possible) or possible[-1]


def of_name(name: str) -> list[Kind]:
    """Our own kinds of a name: several formats of one kind of device."""
    return [kind for kind in KINDS if kind.name == name]


def possible_kinds(path: Path) -> list[Kind]:
    """Kinds of files with a suffix. Raises WearcapError where there is none, with what to do about usual ones."""
    if possible := [kind for kind in kinds() if kind.may_be(path)]:
        return possible
    fix = {
        ".fbx": "Export it as BVH (Blender, MotionBuilder and Maya do), and give that.",
        ".vrs": "It holds raw sensors: request Project Aria's MPS for it, and give the folder that MPS returns; with the extra "
        "wearcap[aria] the camera's pictures are taken from a data.vrs beside it.",
    }.get(path.suffix.lower(), "")
    raise WearcapError("not a kind of file that holds a recording", path, ", ".join(SUFFIXES), fix)


def sources(path: Path, how: Conventions = DETECTED) -> dict[str, Callable[[], Loaded]]:
    """What loads each recording in a path, by name: a data set's, a folder's motions, else its logs; or the one that it is.

    Raises WearcapError where there is none.
    """
    if not path.exists() and not (path.parent / MANIFEST).is_file():
        raise WearcapError("no such file or folder", where=path)
    if (path / MANIFEST).is_file():
        return {name: partial(load, path / name, how) for name in RecordingStore.open(path).names()}
    if path.is_file():
        possible_kinds(path)  # raises for a file that nothing reads
    if not path.is_dir():
        return {path.name: partial(load, path, how)}
    if kind := known(path, kinds()):
        parts = kind.parts(path) if kind.parts else [None]
        return {part or path.resolve().name: partial(kind.load, path, how, part) for part in parts}
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and any(k.may_be(file) for k in MOTIONS)]
    files = files or list(log_files(path))
    if not files:
        raise WearcapError(
            "nothing to examine here",
            where=path,
            expected=f"a data set (manifest.json), an MPS, Nymeria, ADT, TotalCapture or HPS folder, a scene (pointcloud.ply, photos.json), an environment (environment.json), logs of watches, headsets or trajectories, or files like {', '.join(SUFFIXES)}",
        )
    return {file.relative_to(path).as_posix(): partial(load, file, how) for file in files}


def _load_stored(path: Path) -> Loaded:
    """A recording of a data set with its bytes rehashed, and whether the files that it names are there."""
    recording, root = load_recording(path), path if (path / MANIFEST).is_file() else path.parent
    if not (root / MANIFEST).is_file():
        return Loaded(recording, [])
    RecordingStore.open(root).verify_one(recording.name)
    return Loaded(recording, check_files(recording, root))


def _load_foreign(path: Path, how: Conventions) -> Loaded:
    """A motion file of any origin on our skeleton; the note says what was detected."""
    found = read_foreign_motion(path, how=how)
    motion, name = found.motion, path.name.split(".")[0]
    recording = Recording(name, motion=motion, skeleton=motion.skeleton, note=found.report.summary())
    return Loaded(recording, [Check("file").ok("a body was found", " ".join(found.report.lines()))])


def _load_markers(path: Path, how: Conventions) -> Loaded:
    """Optical markers as the motion of a body that is fitted to this trial alone."""
    markers = read_markers(path, how)
    # Markers that are never seen at a time, or kilometres apart, leave equations without a solution.
    unsolved = (RuntimeError, ValueError, LookupError)
    with placed(path), understood("no body fits these markers", path, "a person", "Check the unit.", unsolved):
        body = fit_body([markers])
        motion, distance = fit_motion(body, markers)
    fitted, check = f"{len(body.names)} markers, {1000 * rms_m(distance):.0f} mm (rms) from the body", Check("markers")
    notes = fit_notes(body, markers, distance)
    recording = Recording(
        path.name.split(".")[0], motion=motion, skeleton=motion.skeleton, note="; ".join([fitted, *notes])
    )
    return Loaded(recording, [check.ok("a body was fitted", fitted), *(check.note(note) for note in notes)])


def _read_motion_folder(folder: Path) -> Recording:
    """What `wearcap live record=DIR` left of a wearer, also where it was killed."""
    motion = read_sections(motion_files(folder))
    return Recording(folder.resolve().name, motion=motion, skeleton=motion.skeleton)


def _read_points(path: Path) -> Recording:
    points = (read_pcd if ".pcd" in path.suffixes else read_ply)(path).points
    return Recording(path.name, points=PointCloud(torch.from_numpy(points).float()))


MOTIONS = (
    Kind("AMC", _load_foreign, (".amc",), stated=("unit", "up")),
    Kind("BVH", _load_foreign, (".bvh",), stated=("unit", "up")),
    Kind("markers", _load_markers, (".c3d", ".trc"), stated=("unit", "up")),
    Kind("MVNX", read_suit, (".mvnx",)),
    Kind(
        "trajectory",
        load_trajectory,
        (".npz",),
        lambda path: read_npz(path, ("traj_est", "tstamps", "tstamp")),
        OF_TRAJECTORIES,
    ),
    Kind("motion", read_motion, (".npz",), lambda path: read_npz(path, ("wearcap",))),
    Kind("AMASS", lambda path, how: read_amass(path, how.up), (".npz",), stated=("up",)),
)
"""Files that may hold a body's motion."""
KINDS = (
    Kind("MPS", load_mps, knows=is_mps_folder),
    Kind("place", read_place, knows=is_place),
    Kind("motion", _read_motion_folder, knows=motion_files),
    Kind("headset", load_headset, knows=is_headset_session, stated=OF_HEADSETS),
    Kind("kit", load_kit, knows=is_kit, stated=(*CHOICES, "unit", "fps")),
    Kind("trajectory", load_trajectory, knows=trajectory_file, stated=OF_TRAJECTORIES),
    *MOTIONS,
    Kind("map", read_map, (".safetensors",), is_map),
    Kind("recording", lambda path: RecordingFile(path).load(), (".safetensors",)),
    *LOGS,
    Kind("trajectory", load_trajectory, (".bin",), trajectory_format, OF_TRAJECTORIES),
    Kind("environment", read_environment_file, (".json",)),
    Kind("points", _read_points, (".ply", ".pcd")),
)
"""The kinds that wearcap itself knows; the first that knows a path is the one."""
SUFFIXES = tuple(dict.fromkeys(suffix for kind in KINDS for suffix in kind.suffixes))
