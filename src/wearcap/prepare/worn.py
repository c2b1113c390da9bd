"""Data sets of worn sensors: HPS, EgoHOI, H-contact, Nymeria, Project Aria, MocapEvery's captures and TotalCapture.

Each source has a function that lists its recordings as tasks, preceded by the one that makes a recording of it.
"""

from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

import roma
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.datasets.egohoi import egohoi_names, read_egohoi
from wearcap.io.datasets.hcontact import ENDING, hcontact_names, read_hcontact, read_hcontact_split
from wearcap.io.datasets.hps import hps_names, nominal_mount, read_hps_sequence, resampled_localization, subject_of
from wearcap.io.datasets.mocap_every_folder import (
    MocapEveryFolder,
    is_mocap_every_folder,
    mocap_every_files,
    mocap_every_recording,
    read_mocap_every_folder,
)
from wearcap.io.datasets.nymeria import head_vrs, is_nymeria, read_metadata, read_nymeria
from wearcap.io.datasets.totalcapture import TotalCaptureFiles, read_totalcapture, totalcapture_files
from wearcap.io.devices.aria_mps import is_mps_folder, mps_files, read_mps
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.prepare.engine import NOTE, Splits, Task, changed, content_hash, source_folder
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording, on_xsens23, without_glitches
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ImuStream, Recording
from wearcap.recording.timing import resampled
from wearcap.sensors.camera_alignment import align_by_walks
from wearcap.sensors.monocular_slam import clean_track

VERSION = {"hps": 2, "egohoi": 1, "hcontact": 1, "nymeria": 2, "aria": 2, "mocap_every_folder": 2, "totalcapture": 2}
"""Versions of the conversions, increased when the same source and settings yield another recording."""
MOUNT_S, MOUNT_DEG = 1.0, 35.0
"""Time from a sequence's start in which sensors are calibrated to the body, as a calibration pose does; and the largest
median angle that is then between a sensor and the body (forearms bend against their hands)."""


def _hps(root: Path, name: str, fps: float | int, camera_hz: float | int, license: str) -> Recording:
    """Motion, suit and localisation at `fps`; the video keeps its own rate, the sensors theirs."""
    read = read_hps_sequence(root, name, camera_hz=camera_hz)
    assert read.motion is not None
    return replace(
        read,
        motion=resampled(read.motion, fps),
        license=license,
        suit=None if read.suit is None else resampled(read.suit, fps),
        localization=None if read.localization is None else resampled_localization(read.localization, fps),
    )


def hps_tasks(source: str | Path, splits: Splits, fps: float | int, camera_hz: float | int, license: str) -> list[Task]:
    """One task per sequence in `source`/hps_smpl; hashed by all files with its name and its subject's betas."""
    source = source_folder(source)
    names = hps_names(source)
    if not names:
        raise WearcapError("no sequences", where=source, expected="hps_smpl/NAME.pkl, as the HPS data set unpacks")
    tasks = []
    for name in names:
        subject = subject_of(name)
        patterns = (f"*/{name}[._]*", f"*betas*/{subject}.json", "*/cameras.json")
        files = sorted(path for pattern in patterns for path in source.glob(pattern))
        small = [path for path in files if path.suffix.lower() != ".mp4"]  # only a video's rate and length matter
        key = content_hash(name, float(fps), float(camera_hz), license, VERSION["hps"], *small)
        tasks.append(Task(name, partial(_hps, source, name, fps, camera_hz, license), splits.of(subject), key))
    return tasks


def _egohoi(
    root: Path,
    name: str,
    motion_types: dict[str, str],
    object_name: str | None,
    fps: float | int,
    license: str,
    output: Path,
) -> Recording:
    """The body at `fps` and the annotated object poses; the environment is written beside the recording."""
    recording, environment = read_egohoi(root, name, motion_types, object_name)
    assert recording.motion is not None
    file = Path("scenes") / name / FILE_NAME
    write_environment(environment, output / file)
    motion = resampled(recording.motion, fps)
    return replace(recording, motion=motion, environment=file.as_posix(), license=license)


def egohoi_tasks(
    source: str | Path,
    output: str | Path,
    splits: Splits,
    motion_types: dict[str, str],
    object_names: dict[str, str],
    fps: float | int,
    license: str,
) -> list[Task]:
    """One task per sequence in `source`/smpl_motions; environments go to `output`/scenes.

    `motion_types` and `object_names` as `read_egohoi` takes them, the latter by sequence. Raises WearcapError without
    sequences.
    """
    source = Path(source)
    names = egohoi_names(source)
    if not names:
        expected, fix = "smpl_motions/NAME.json.zip or .json", "Give EgoHOI's folder as source=DIR."
        raise WearcapError("no sequences", where=source, expected=expected, fix=fix)
    models = sorted(source.glob("object_models/*.ply"))
    tasks = []
    for name in names:
        subject, object_name = subject_of(name), object_names.get(name)
        files = [*sorted(source.glob(f"*/{name}.json*")), *sorted(source.glob(f"*/{name}/*.json")), *models]
        files += [path for path in [source / "smpl_shapes" / f"{subject}.json"] if path.is_file()]
        key = content_hash(name, motion_types, object_name, float(fps), license, VERSION["egohoi"], *files)
        make = partial(_egohoi, source, name, motion_types, object_name, fps, license, Path(output))
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks


def _hcontact(root: Path, name: str, contact_class: str, fps: float | int, license: str) -> Recording:
    """The motion at `fps`; contacts keep their times."""
    read = read_hcontact(root, name, contact_class)
    assert read.motion is not None
    motion = resampled(read.motion, fps)
    if not read.motion.t_world_root.any():
        motion = replace(motion, provenance=motion.provenance | {NOTE: "the body's place is not known"})
    return replace(read, motion=motion, license=license)


def hcontact_tasks(
    source: str | Path, splits: Splits, classes: dict[str, str], fps: float | int, license: str
) -> list[Task]:
    """One task per sequence in `source`/body; `classes` maps patterns of names to contact classes, the first match decides.

    A subject with windows in the data set's own `splits/`, none of them for training, belongs to test, regardless of the
    list. Raises WearcapError without sequences, and for a name that no pattern matches.
    """
    source = Path(source)
    names = hcontact_names(source)
    if not names:
        expected, fix = f"body/NAME{ENDING} and contacts/NAME.json", "Give H-contact's folder as source=DIR."
        raise WearcapError("no sequences", where=source, expected=expected, fix=fix)
    trains: dict[str, bool] = {}
    for path in sorted(source.glob("splits/**/*.json")):
        if path.stem in names:
            subject = subject_of(path.stem)
            trains[subject] = bool(read_hcontact_split(path)["train"]) or trains.get(subject, False)
    tasks = []
    for name in names:
        kind = next((kind for pattern, kind in classes.items() if fnmatchcase(name, pattern)), None)
        if kind is None:
            what = f"no contact class for sequence {name!r}"
            raise WearcapError(what, expected="a pattern of `classes` that matches it")
        subject = subject_of(name)
        files = [source / "body" / f"{name}{ENDING}", source / "contacts" / f"{name}.json"]
        there = [path for path in files if path.is_file()]
        key = content_hash(name, kind, float(fps), license, VERSION["hcontact"], *there)
        split = splits.of(subject) if trains.get(subject, True) else "test"
        tasks.append(Task(name, partial(_hcontact, source, name, kind, fps, license), split, key))
    return tasks


def nymeria_tasks(
    source: str | Path, splits: Splits, fps: float | int, license: str, camera: bool = False, output: str = "."
) -> list[Task]:
    """One task per sequence folder (with `body/xdata.npz`) below `source`; hashed by its motion, head path and points.

    With `camera`, the video of the head's colour camera is written to `output`/videos, for sequences with `data.vrs`.
    """
    source = source_folder(source)
    folders = sorted(path.parents[1] for path in source.rglob("xdata.npz") if is_nymeria(path.parents[1]))
    if not folders:
        raise WearcapError("no sequences", where=source, expected="folders with body/xdata.npz")
    tasks = []
    for folder in folders:
        name, about, vrs = folder.resolve().name, read_metadata(folder), head_vrs(folder)
        video = Path(output) / "videos" / f"{name}.mp4" if camera and vrs.is_file() else None
        files = [folder / "body" / "xdata.npz", *mps_files(folder / "recording_head")]
        filmed_bytes = vrs.stat().st_size if video else 0
        key = content_hash(name, float(fps), VERSION["nymeria"], about, *files, filmed_bytes)
        read = partial(read_nymeria, folder, fps=float(fps), video=video)
        tasks.append(Task(name, partial(changed, read, name=name, license=license), splits.of(about["subject"]), key))
    return tasks


def aria_tasks(source: str | Path, splits: Splits, subject: str, fps: float | int, license: str) -> list[Task]:
    """One task per closed-loop trajectory at or below `source`, named after its recording's folder."""
    source = source_folder(source)
    folders: dict[Path, Path] = {}  # by trajectory, the outermost folder: REC of REC/slam and REC/mps/slam, too
    for folder in sorted([source, *(path for path in source.rglob("*") if path.is_dir())]):
        if is_mps_folder(folder):
            folders.setdefault(mps_files(folder)[0], folder)
    if not folders:
        raise WearcapError("no MPS output", where=source, expected="folders with closed_loop_trajectory.csv")
    tasks = []
    for folder in folders.values():
        name = folder.resolve().name
        key = content_hash(name, subject, float(fps), VERSION["aria"], *mps_files(folder))
        read = partial(read_mps, folder, fps=float(fps))
        make = partial(changed, read, name=name, subject=subject, license=license)
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks


@dataclass(frozen=True)
class MocapEverySettings:
    """Settings of the conversion of a capture folder to a recording in metres, z up."""

    scale: float | int | None
    """Metres per unit of SLAM, with the first camera pose taken as level; None: from the calibration board."""
    height_m: float | int
    """Height (m) of the first camera pose above the floor, used with `scale`."""
    max_acceleration: float | int
    """Acceleration (m/s²) beyond which camera poses are outliers."""
    max_burst_s: float | int

    def alignment(self, read: MocapEveryFolder, folder: Path) -> tuple[float, Rigid]:
        """Scale and T_world_slam from the calibration board, or from a given scale and a level first pose."""
        if self.scale is None:
            if read.board is None:
                what = "it does not define the length of a unit of SLAM"
                expected = "cam_scale_origin in config.yaml, and x and y in camera_calib.pkl"
                fix = "Measure it, and give scale=METRES_PER_UNIT."
                raise WearcapError(what, where=folder, expected=expected, fix=fix)
            board = read.board
            return align_by_walks(board.x_slam, board.y_slam, board.length_m, board.height_m)
        if self.scale <= 0:
            raise WearcapError(f"scale={self.scale}", expected="metres per unit of SLAM, above 0")
        R_world_cam, _ = nominal_mount()
        R_world_slam = R_world_cam @ read.T_slam_cam.R_world_body[0].mT
        first = self.scale * read.T_slam_cam.t_world_body[0]
        start = torch.tensor([0.0, 0.0, self.height_m])
        return float(self.scale), Rigid(R_world_slam, start - R_world_slam @ first)


def _mocap_every(folder: Path, name: str, subject: str, settings: MocapEverySettings, license: str) -> Recording:
    """A recording without outlier poses, which are detected in metres before the world is changed."""
    read = read_mocap_every_folder(folder)
    scale, T_world_slam = settings.alignment(read, folder)
    clean, _, _ = clean_track(read.T_slam_cam, settings.max_acceleration / scale, settings.max_burst_s)
    recording = mocap_every_recording(replace(read, T_slam_cam=clean), scale, T_world_slam)
    return replace(recording, name=name, subject=subject, license=license)


def mocap_every_folder_tasks(
    source: str | Path, splits: Splits, subject: str, settings: MocapEverySettings, license: str
) -> list[Task]:
    """One task per capture folder at or below `source`; hashed by all files read, a video by its size."""
    source = source_folder(source)
    folders = [path for path in sorted([source, *source.rglob("*")]) if is_mocap_every_folder(path)]
    if not folders:
        raise WearcapError("no capture", where=source, expected="folders with cam_traj.pkl")
    tasks = []
    for folder in folders:
        name, files = folder.resolve().name, mocap_every_files(folder)
        small = [path for path in files if path.suffix.lower() != ".mp4"]
        sizes = [path.stat().st_size for path in files if path not in small]
        version = VERSION["mocap_every_folder"]
        key = content_hash(name, subject, vars(settings), license, version, sizes, *small)
        make = partial(_mocap_every, folder, name, subject, settings, license)
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks


def _totalcapture(files: TotalCaptureFiles, about: About, settings: MocapSettings) -> Recording:
    """The body on xsens23 and all sensors, the mount of each from the sequence's first second."""
    read = read_totalcapture(files)
    motion, note = without_glitches(on_xsens23(read.motion), settings.limits)
    noted = replace(motion, provenance=motion.provenance | ({NOTE: note} if note else {}))
    imu = {joint: _mounted(stream, motion, files.sensors) for joint, stream in read.imu.items()}
    return replace(mocap_recording(noted, about, settings), imu=imu)


def _mounted(stream: ImuStream, motion: Motion, where: Path) -> ImuStream:
    """A sensor in the span of a motion and on its clock from 0, mounted as its first second says.

    Raises WearcapError for a sensor that does not turn with its joint: of another one, or in another world.
    """
    first, last = motion.timestamps[0], motion.timestamps[-1]
    inside = (stream.timestamps >= first) & (stream.timestamps <= last)
    parts = {name: getattr(stream, name)[inside] for name in ("R_world_imu", "acc_world", "acc_imu", "gyro_imu")}
    R_joint_imu = motion.joint(stream.joint).R.mT @ parts["R_world_imu"]
    calibrated = motion.timestamps - first <= MOUNT_S
    mount = torch.as_tensor(roma.special_procrustes(R_joint_imu[calibrated].mean(0)))
    off = rotation.geodesic(R_joint_imu, mount.expand_as(R_joint_imu)).rad2deg().median().item()
    if off > MOUNT_DEG:
        what = f"the sensor of {stream.joint} is {off:.0f}° from the body in half of the frames"
        raise WearcapError(what, where, "the body's own sensors, in Vicon's world", "Is it another sequence's file?")
    return replace(stream, timestamps=stream.timestamps[inside] - first, R_joint_imu=mount, **parts)


def totalcapture_tasks(source: str | Path, splits: Splits, settings: MocapSettings, license: str) -> list[Task]:
    """One task per sequence with all its files at or below `source`, named SUBJECT_ACTION."""
    source = source_folder(source)
    found = totalcapture_files(source)
    if not found:
        expected = "gt_skel_gbl_pos.txt and _ori.txt, *_Xsens_AuxFields.sensors, *_calib_imu_ref.txt below s1 … s5"
        raise WearcapError(
            "no sequences", where=source, expected=expected, fix="Unpack TotalCapture's Vicon and IMU archives."
        )
    tasks = []
    for files in found:
        about = About(
            f"{files.subject}_{files.action}", files.subject, "totalcapture", license, files.action.rstrip("0123456789")
        )
        paths = [files.positions, files.orientations, files.sensors, files.reference]
        key = content_hash(asdict(about), asdict(settings), VERSION["totalcapture"], *paths)
        tasks.append(Task(about.name, partial(_totalcapture, files, about, settings), splits.of(files.subject), key))
    return tasks
