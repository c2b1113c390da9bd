"""One reader for whatever a user has: `read(path)` returns a Recording."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from wearcap.boundary.arrays import read_npz
from wearcap.doctor.logs import is_kit, log_kind, read_kit, read_table
from wearcap.errors import WearcapError
from wearcap.io.datasets.adt import is_adt, read_adt
from wearcap.io.datasets.amass import read_amass
from wearcap.io.datasets.nymeria import is_nymeria, read_nymeria, read_xdata
from wearcap.io.datasets.totalcapture import is_totalcapture, read_totalcapture, totalcapture_files
from wearcap.io.devices.aria_mps import head_stream, is_mps_folder, read_closed_loop, read_mps
from wearcap.io.formats.motion_npz import motion_files, read_motion, read_sections
from wearcap.io.formats.trajectory import trajectory_format
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.prepare.logs import HeadsetSettings, TrajectorySettings, read_path
from wearcap.prepare.suits import read_suit
from wearcap.recording import Motion, Recording
from wearcap.recording.store import MANIFEST, RecordingFile, load_recording

PACKED = (".gz", ".xz")


def read(where: str | Path) -> Recording:
    """Read a recording from whatever holds one.

    That is a prepared recording (DATASET/NAME or its .safetensors), MVNX, BVH, AMC with its ASF, AMASS or SMPL .npz, our
    motion .npz, a trajectory, a watch's or a headset's log, or a folder of Aria MPS, Nymeria, Aria Digital Twin or
    TotalCapture, or of one session's logs. A suit without foot contacts gets those of its feet's speed. Names are those of
    the files. Raises WearcapError for what cannot be read.
    """
    path = Path(where)
    if not path.exists() or (path / MANIFEST).is_file():
        return load_recording(path)
    if path.is_dir():
        for is_kind, read_folder in _FOLDERS:
            if is_kind(path):
                return read_folder(path)
        return load_recording(path)
    kind = kind_of(path)
    if kind is None:
        fix = "Markers have no skeleton yet: solve them, and give the BVH." if path.suffix.lower() == ".c3d" else ""
        raise WearcapError("not a kind of file that holds a recording", path, ", ".join(READERS), fix)
    content = READERS[kind](path)
    if isinstance(content, Motion):
        content = Recording(path.name.split(".")[0], motion=content, skeleton=content.skeleton)
    return content


def kind_of(path: Path) -> str | None:
    """Suffix that determines a file's format, without compression; None for one that `read` does not know."""
    suffixes = [suffix.lower() for suffix in path.suffixes if suffix.lower() not in PACKED]
    return suffixes[-1] if suffixes and suffixes[-1] in READERS else None


def _read_foreign(path: Path) -> Recording:
    """A motion file of any origin on our skeleton; the note says what was detected."""
    found = read_foreign_motion(path)
    name = path.name.split(".")[0]
    return Recording(name, motion=found.motion, skeleton=found.motion.skeleton, note=found.report.summary())


def _read_log(path: Path) -> Recording:
    """A watch's or headset's log, or a trajectory of any format, by content; with what was detected as its note."""
    name, kind = path.name.split(".")[0], log_kind(path)
    if kind == "watch":
        return replace(read_table(path)[0], name=name)
    if kind == "headset":
        return HeadsetSettings().read(path, name, {})
    if "aria_trajectory" in path.name or (kind == "trajectory" and trajectory_format(path) == "MPS"):
        track = read_closed_loop(path, up="y" if "aria_trajectory" in path.name else "z")[0]
        return Recording(name, head=head_stream(track, fps=None), source="Aria MPS")
    return read_path(path, name, {}, TrajectorySettings())


def _read_npz(path: Path) -> Recording | Motion:
    """A wearcap motion, Nymeria's suit data, DROID-SLAM's poses, or an AMASS file, recognised by its arrays."""
    if path.name == "xdata.npz":
        return read_xdata(path)[0]
    if read_npz(path, ("traj_est", "tstamps", "tstamp")):
        return read_path(path, path.stem, {}, TrajectorySettings())
    return read_motion(path) if read_npz(path, ("wearcap",)) else read_amass(path)


def _read_motion_folder(folder: Path) -> Recording:
    """What `wearcap live record=DIR` left of a wearer, also where it was killed."""
    motion = read_sections(motion_files(folder))
    return Recording(folder.name, motion=motion, skeleton=motion.skeleton)


def _totalcapture(folder: Path) -> Recording:
    """A sequence in Vicon's skeleton; where the sensors are mounted is not known."""
    found = read_totalcapture(totalcapture_files(folder)[0])
    return Recording(folder.name, motion=found.motion, imu=found.imu, source="TotalCapture")


_FOLDERS: tuple[tuple[Callable[[Path], bool], Callable[[Path], Recording]], ...] = (
    (is_nymeria, read_nymeria),
    (is_mps_folder, read_mps),
    (is_adt, read_adt),
    (is_totalcapture, _totalcapture),
    (lambda folder: bool(motion_files(folder)), _read_motion_folder),
    (is_kit, lambda folder: read_kit(folder)[0]),
)
READERS: dict[str, Callable[[Path], Recording | Motion]] = {
    ".amc": _read_foreign,
    ".bvh": _read_foreign,
    ".mvnx": read_suit,
    ".npz": _read_npz,
    ".safetensors": lambda path: RecordingFile(path).load(),
    **dict.fromkeys((".csv", ".txt", ".tum", ".log", ".json", ".jsonl", ".npy", ".bin"), _read_log),
}
"""Readers by suffix."""
