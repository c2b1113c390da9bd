"""One reader for whatever a user has: `read(path)` returns a Recording, `load(path)` also what its reader found.

`capture`, `evaluate`, `live`, `view` and the doctor read by the same table: by suffix, or for logs by content.
"""

from collections.abc import Callable
from pathlib import Path

import torch

from wearcap.boundary.arrays import read_npz
from wearcap.checks.consistency import check_files
from wearcap.checks.examine import require_sound
from wearcap.checks.places import is_map, is_place, read_environment_file, read_map, read_place
from wearcap.checks.report import Check, Finding
from wearcap.errors import WearcapError
from wearcap.io.conventions import DETECTED, Conventions
from wearcap.io.datasets.adt import is_adt, read_adt
from wearcap.io.datasets.amass import read_amass
from wearcap.io.datasets.nymeria import is_nymeria, read_nymeria, read_xdata
from wearcap.io.datasets.totalcapture import is_totalcapture, read_totalcapture, totalcapture_files
from wearcap.io.devices.aria_mps import is_mps_folder
from wearcap.io.devices.headset_log import is_headset_log, is_headset_session
from wearcap.io.formats.motion_npz import motion_files, read_motion, read_sections
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.trajectory import trajectory_file, trajectory_format
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.prepare.suits import read_suit
from wearcap.reading.kits import Loaded, is_kit, load_headset, load_kit, load_log, load_mps, load_trajectory
from wearcap.recording import Motion, PointCloud, Recording, RecordingStore
from wearcap.recording.store import MANIFEST, RecordingFile, load_recording

PACKED = (".gz", ".xz")
Read = Callable[[Path, Conventions], Recording | Motion | Loaded]


def read(where: str | Path, how: Conventions = DETECTED, check: bool = False) -> Recording:
    """Read a recording from whatever holds one.

    That is a prepared recording (DATASET/NAME or its .safetensors), MVNX, BVH, AMC with its ASF, AMASS or SMPL .npz, our
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
    if path.is_dir():
        chosen = next((load_folder for is_kind, load_folder in FOLDERS if is_kind(path)), None)
        if chosen is None:
            return Loaded(load_recording(path), [])
    else:
        kind = kind_of(path)
        if kind is None:
            raise unknown_kind(path)
        chosen = FILES[kind]
    content = chosen(path, how)
    if isinstance(content, Motion):
        content = Recording(path.name.split(".")[0], motion=content, skeleton=content.skeleton)
    if isinstance(content, Recording):
        content = Loaded(content, [Check("file").ok("read", content.note)] if content.note else [])
    return content


def kind_of(path: Path) -> str | None:
    """Suffix that determines a file's format, without compression; None for one that `load` does not know."""
    suffixes = [suffix.lower() for suffix in path.suffixes if suffix.lower() not in PACKED]
    return suffixes[-1] if suffixes and suffixes[-1] in FILES else None


def unknown_kind(path: Path) -> WearcapError:
    """The error for a file that no reader knows, with what to do about usual ones."""
    fix = {
        ".c3d": "Markers have no skeleton yet: solve them, and give the BVH.",
        ".fbx": "Export it as BVH (Blender, MotionBuilder and Maya do), and give that.",
        ".vrs": "It holds raw sensors: request Project Aria's MPS for it, and give the folder that MPS returns; with the extra "
        "wearcap[aria] the camera's pictures are taken from a data.vrs beside it.",
    }.get(path.suffix.lower(), "")
    return WearcapError("not a kind of file that holds a recording", path, ", ".join(FILES), fix)


def _load_stored(path: Path) -> Loaded:
    """A recording of a data set with its bytes rehashed, and whether the files that it names are there."""
    recording, root = load_recording(path), path if (path / MANIFEST).is_file() else path.parent
    if not (root / MANIFEST).is_file():
        return Loaded(recording, [])
    RecordingStore.open(root).verify_one(recording.name)
    return Loaded(recording, check_files(recording, root))


def _load_foreign(path: Path, how: Conventions) -> Loaded:
    """A motion file of any origin on our skeleton; the note says what was detected."""
    how.only("unit", "up", where=path)
    found = read_foreign_motion(path, how=how)
    motion, name = found.motion, path.name.split(".")[0]
    recording = Recording(name, motion=motion, skeleton=motion.skeleton, note=found.report.summary())
    return Loaded(recording, [Check("file").ok("a body was found", " ".join(found.report.lines()))])


def _load_json(path: Path, how: Conventions) -> Loaded:
    if trajectory_format(path):
        return load_trajectory(path, how)
    return load_log(path, how) if is_headset_log(path) else Loaded(*read_environment_file(path))


def _load_npz(path: Path, how: Conventions) -> Recording | Motion | Loaded:
    """A wearcap motion, Nymeria's suit data, DROID-SLAM's poses, or an AMASS file, recognised by its arrays."""
    if path.name == "xdata.npz":
        return _plain(lambda file: read_xdata(file)[0])(path, how)
    if read_npz(path, ("traj_est", "tstamps", "tstamp")):
        return load_trajectory(path, how)
    if read_npz(path, ("wearcap",)):
        return _plain(read_motion)(path, how)
    how.only("up", where=path)
    return read_amass(path, how.up)


def _read_motion_folder(folder: Path) -> Recording:
    """What `wearcap live record=DIR` left of a wearer, also where it was killed."""
    motion = read_sections(motion_files(folder))
    return Recording(folder.resolve().name, motion=motion, skeleton=motion.skeleton)


def _read_totalcapture(folder: Path) -> Recording:
    """A sequence in Vicon's skeleton; where the sensors are mounted is not known."""
    found = read_totalcapture(totalcapture_files(folder)[0])
    return Recording(folder.resolve().name, motion=found.motion, imu=found.imu, source="TotalCapture")


def _read_points(path: Path) -> Recording:
    points = (read_pcd if ".pcd" in path.suffixes else read_ply)(path).points
    return Recording(path.name, points=PointCloud(torch.from_numpy(points).float()))


def _read_safetensors(path: Path) -> Recording | Loaded:
    return Loaded(*read_map(path)) if is_map(path) else RecordingFile(path).load()


def _plain(read_file: Callable[[Path], Recording | Motion | Loaded | tuple[Recording, list[Finding]]]) -> Read:
    """A reader of a format that fixes all conventions: stated ones are refused."""

    def read_fixed(path: Path, how: Conventions) -> Recording | Motion | Loaded:
        how.only(where=path)
        content = read_file(path)
        return Loaded(*content) if isinstance(content, tuple) else content

    return read_fixed


FOLDERS: tuple[tuple[Callable[[Path], object], Read], ...] = (
    (is_nymeria, _plain(read_nymeria)),
    (is_mps_folder, _plain(load_mps)),
    (is_adt, _plain(read_adt)),
    (is_totalcapture, _plain(_read_totalcapture)),
    (is_place, _plain(read_place)),
    (motion_files, _plain(_read_motion_folder)),
    (is_headset_session, load_headset),
    (is_kit, load_kit),
    (trajectory_file, load_trajectory),
)
"""Readers of folders, the first that knows it."""
FILES: dict[str, Read] = {
    ".amc": _load_foreign,
    ".bvh": _load_foreign,
    ".mvnx": _plain(read_suit),
    ".npz": _load_npz,
    ".safetensors": _plain(_read_safetensors),
    ".json": _load_json,
    **dict.fromkeys((".csv", ".tsv", ".txt", ".tum", ".log", ".jsonl", ".npy", ".bin", ".bsor"), load_log),
    **dict.fromkeys((".ply", ".pcd"), _plain(_read_points)),
}
"""Readers of files by suffix."""
MOTIONS = (".amc", ".bvh", ".mvnx", ".npz")
