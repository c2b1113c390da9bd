"""The TotalCapture data set: thirteen Xsens sensors on a body that Vicon measures, five subjects, 60 Hz.

Files of a sequence, all in one folder or each kind below a folder of its own, the subject (s1 … s5) in the path:
`ACTION/gt_skel_gbl_pos.txt` and `gt_skel_gbl_ori.txt` (a line of 21 joint names, then "x y z" in inches and
quaternions per frame, tab-separated, y up), `ACTION_Xsens_AuxFields.sensors` ("sensors frames", then per frame its
number and a line per sensor: name, orientation w x y z, specific force, angular velocity, magnetic field), and
`SUBJECT_ACTION_calib_imu_ref.txt` (name, x y z w: the sensors' common world in Vicon's). Both end together.
"""

import re
from array import array
from collections import defaultdict
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from data_prep.shared.engine import NOTE, Splits, Task, source_folder
from data_prep.shared.mocap import MOCAP, About, MocapSettings, mocap_recording, on_xsens23, without_glitches
from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import Skeleton
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.geometry.light_roma import roma
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.io.devices.axes import WORLDS
from wearcap.io.formats.poses import NORM_TOLERANCE
from wearcap.reading.kinds import Kind
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ImuStream, Recording

FPS = 60.0
INCH_M = 0.0254
GRAVITY = 9.81
PARENTS = {
    "Hips": "", "Spine": "Hips", "Spine1": "Spine", "Spine2": "Spine1", "Spine3": "Spine2", "Neck": "Spine3",
    "Head": "Neck", "RightShoulder": "Spine3", "RightArm": "RightShoulder", "RightForeArm": "RightArm",
    "RightHand": "RightForeArm", "LeftShoulder": "Spine3", "LeftArm": "LeftShoulder", "LeftForeArm": "LeftArm",
    "LeftHand": "LeftForeArm", "RightUpLeg": "Hips", "RightLeg": "RightUpLeg", "RightFoot": "RightLeg",
    "LeftUpLeg": "Hips", "LeftLeg": "LeftUpLeg", "LeftFoot": "LeftLeg",
}  # fmt: skip
"""Vicon's joints and their parents."""
SENSORS = {
    "Head": "head", "Sternum": "t8", "Pelvis": "pelvis", "L_UpArm": "left_shoulder", "R_UpArm": "right_shoulder",
    "L_LowArm": "left_wrist", "R_LowArm": "right_wrist", "L_UpLeg": "left_hip", "R_UpLeg": "right_hip",
    "L_LowLeg": "left_knee", "R_LowLeg": "right_knee", "L_Foot": "left_ankle", "R_Foot": "right_ankle",
}  # fmt: skip
"""Joints of xsens23 that the sensors are worn on; those of the forearms sit where a watch does."""
_VALUES = 13
"""Numbers of a sensor and frame: orientation, specific force, angular velocity, magnetic field."""
_MOST_SENSORS = 64
_RIGID_M = 0.02
"""Largest deviation (root mean square) of a joint's place in its parent's axes."""
_TILT = 0.2
"""Largest share of gravity that may be left on average when it is taken off."""
_WORLD_VICON = WORLDS["y"]
_KINDS = {
    "positions": r"gt_skel_gbl_pos\.txt",
    "orientations": r"gt_skel_gbl_ori\.txt",
    "sensors": r"(?P<sensors>.+)_xsens_auxfields\.sensors",
    "reference": r"(?P<reference>.+)_calib_imu_ref\.txt",
}


@dataclass(frozen=True)
class TotalCaptureFiles:
    """Files of one sequence."""

    subject: str
    action: str
    positions: Path
    orientations: Path
    sensors: Path
    reference: Path


@dataclass(frozen=True, eq=False)
class TotalCaptureSequence:
    """The body in Vicon's own skeleton, z up, and the sensors on its clock."""

    motion: Motion
    imu: dict[str, ImuStream]
    """By the joint that the sensor is worn on; how it is mounted there is not known."""


def totalcapture_files(root: str | Path) -> list[TotalCaptureFiles]:
    """Sequences at or below a folder that have all their files."""
    found: dict[tuple[str, str], dict[str, Path]] = defaultdict(dict)
    for path in sorted(Path(root).resolve().rglob("*")):
        subjects = [part.lower() for part in path.parts[:-1] if re.fullmatch(r"[sS]\d+", part)]
        for kind, pattern in _KINDS.items():
            match = re.fullmatch(pattern, path.name, re.IGNORECASE)
            if match and subjects and path.is_file():
                name = match.groupdict().get(kind) or path.parent.name
                action = name.lower().removeprefix(f"{subjects[-1]}_")
                found[subjects[-1], action].setdefault(kind, path)
    return [TotalCaptureFiles(*key, **files) for key, files in sorted(found.items()) if len(files) == len(_KINDS)]


def is_totalcapture(folder: str | Path) -> bool:
    """Whether a folder is that of one sequence, with all its files in it."""
    return (Path(folder) / "gt_skel_gbl_pos.txt").is_file() and len(totalcapture_files(folder)) == 1


def read_totalcapture(files: TotalCaptureFiles) -> TotalCaptureSequence:
    """Read one sequence; of files that differ in length the ends belong together.

    Raises WearcapError for files that are not as documented, orientations that do not carry the joints (the order of a
    quaternion's numbers is found by that), and sensors whose acceleration at their orientation does not hold gravity.
    """
    sensors, reference = read_sensors(files.sensors), read_reference(files.reference)
    positions = INCH_M * read_vicon(files.positions, 3)
    quaternions = read_vicon(files.orientations, 4)
    count = min(len(positions), len(quaternions), *(len(rows) for rows in sensors.values()))
    if count < 2:
        raise WearcapError(f"{count} frames that all files have", where=files.positions, expected="two or more")
    times = torch.arange(count, dtype=torch.float64) / FPS
    motion = _vicon_motion(times, positions[-count:], quaternions[-count:], files.orientations)
    imu = {}
    for name, joint in SENSORS.items():
        if name not in sensors or name not in reference:
            lacking = files.sensors if name not in sensors else files.reference
            raise WearcapError(f"no sensor {name}", where=lacking, expected=", ".join(SENSORS))
        imu[joint] = _stream(times, joint, sensors[name][-count:], reference[name], f"{files.sensors}, {name}")
    return TotalCaptureSequence(motion, imu)


def read_sensors(path: str | Path) -> dict[str, Float64[np.ndarray, "time value"]]:
    """Each sensor's numbers by frame: orientation w x y z, force (m/s²), angular velocity (rad/s), magnetic field.

    Raises WearcapError naming the first line that is not as documented.
    """
    values: dict[str, array] = defaultdict(lambda: array("d"))
    sensors = frames = row = 0
    frame = 0
    for number, line in numbered_lines(path):
        fields, where = line.split(), at_line(path, number)
        if not fields:
            continue
        if not sensors:
            sensors, frames = _counts(fields, where)
        elif row == 0:
            frame += 1
            if fields != [str(frame)]:
                raise WearcapError(f"{line.strip()[:40]!r}", where, f"the number of frame {frame}")
            row = sensors
        else:
            if len(fields) != 1 + _VALUES:
                fix = "Take ACTION_Xsens_AuxFields.sensors; the shorter files lack angular velocity and gravity."
                raise WearcapError(f"{len(fields)} fields", where, f"a name and {_VALUES} numbers", fix)
            values[fields[0]].extend(finite_floats(fields[1:], where))
            row -= 1
    if frame != frames or row or len(values) != sensors or len({len(rows) for rows in values.values()}) != 1:
        what = f"{frame} frames of {len(values)} sensors, the last of them {'cut short' if row else 'whole'}"
        raise WearcapError(what, path, f"{frames} frames of {sensors} sensors, as its first line says")
    return {name: np.asarray(rows).reshape(-1, _VALUES) for name, rows in values.items()}


def _counts(fields: list[str], where: str) -> tuple[int, int]:
    counts = [int(field) if field.isascii() and field.isdecimal() and len(field) < 10 else 0 for field in fields]
    if len(counts) != 2 or not (0 < counts[0] <= _MOST_SENSORS and counts[1] > 0):
        raise WearcapError(f"{' '.join(fields)[:40]!r}", where, "the numbers of sensors and of frames")
    return counts[0], counts[1]


def read_reference(path: str | Path) -> dict[str, Float[Tensor, "3 3"]]:
    """Orientation of each sensor's world in Vicon's. Raises WearcapError for lines without name and unit quaternion."""
    found: dict[str, Tensor] = {}
    wanted = 0
    for number, line in numbered_lines(path):
        fields, where = line.split(), at_line(path, number)
        if not wanted:
            wanted = int(fields[0]) if len(fields) == 1 and fields[0].isdecimal() and len(fields[0]) < 4 else 0
            if not wanted:
                raise WearcapError(f"{line.strip()[:40]!r}", where, "the number of sensors")
        elif fields:
            if len(fields) != 5:
                raise WearcapError(f"{len(fields)} fields", where, "a sensor's name and x y z w")
            x, y, z, w = finite_floats(fields[1:], where)
            found[fields[0]] = _rotations(np.array([[w, x, y, z]]), where)[0]
    if len(found) != wanted:
        raise WearcapError(f"{len(found)} sensors", path, f"{wanted}, as its first line says")
    return found


def read_vicon(path: str | Path, size: int) -> Float64[np.ndarray, "time joint value"]:
    """`size` numbers of each joint by frame, joints in the order of `PARENTS`.

    Raises WearcapError for a missing or unknown joint, and lines that do not hold `size` numbers for each.
    """
    names: list[str] = []
    values = array("d")
    for number, line in numbered_lines(path):
        fields, where = line.split(), at_line(path, number)
        if not names:
            names = fields
            if sorted(names) != sorted(PARENTS):
                raise WearcapError(f"joints {' '.join(names)[:80]}", where, " ".join(PARENTS))
        elif fields:
            if len(fields) != size * len(names):
                raise WearcapError(f"{len(fields)} numbers", where, f"{size} for each of {len(names)} joints")
            values.extend(finite_floats(fields, where))
    table = np.asarray(values).reshape(-1, len(PARENTS), size)
    return table[:, [names.index(name) for name in PARENTS]]


def _rotations(quat_wxyz: np.ndarray, where: str | Path) -> Float[Tensor, "*batch 3 3"]:
    norm = np.linalg.norm(quat_wxyz, axis=-1)
    if (np.abs(norm - 1) > NORM_TOLERANCE).any():
        worst = float(norm.flat[np.abs(norm - 1).argmax()])
        raise WearcapError(f"a quaternion of norm {worst:.3f}", where, "unit quaternions")
    return matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz))


def _vicon_motion(times: Tensor, positions: np.ndarray, quaternions: np.ndarray, where: Path) -> Motion:
    """The body in a skeleton of Vicon's joints, whose rest pose faces x, z up."""
    parents = tuple(list(PARENTS).index(parent) if parent else -1 for parent in PARENTS.values())
    p, spreads = torch.from_numpy(positions), []
    for order in ([3, 0, 1, 2], [0, 1, 2, 3]):  # tools disagree about the file's: x y z w or w x y z
        R = _rotations(quaternions[..., order], where)
        carried = (R[:, parents[1:]].mT @ (p[:, 1:] - p[:, parents[1:]])[..., None])[..., 0]
        offset = carried.median(0).values
        spreads.append(((carried - offset).square().sum(-1).mean().sqrt().item(), R, offset))
    (spread, R, offset), (other, _, _) = sorted(spreads, key=lambda row: row[0])
    if not spread < _RIGID_M or not 2 * spread < other:
        what = (
            f"joints move by {100 * spread:.1f} cm in the axes of their parents ({100 * other:.1f} in the other order)"
        )
        fix = "Give the sequence's own two files; a sequence in which nobody moves says nothing."
        raise WearcapError(what, where, f"rigid bones, within {100 * _RIGID_M:.0f} cm", fix)
    rest = dict(zip(list(PARENTS)[1:], offset))
    up = sum(rest[name] for name in ("Spine", "Spine1", "Spine2", "Spine3", "Neck"))
    across = rest["LeftUpLeg"] - rest["RightUpLeg"]
    forward = torch.linalg.cross(across, torch.as_tensor(up))
    axes = [forward, torch.linalg.cross(torch.as_tensor(up), forward), torch.as_tensor(up)]
    R_rest_vicon = torch.stack([axis / axis.norm() for axis in axes])
    W = _WORLD_VICON.double()
    offsets = torch.cat([torch.zeros(1, 3, dtype=torch.float64), offset @ R_rest_vicon.mT])
    skeleton = Skeleton("vicon21", tuple(PARENTS), parents, offsets.float())
    R_world_joint = (W @ R @ R_rest_vicon.mT).float()
    return Motion(times, skeleton, local_rotations(skeleton, R_world_joint), (p[:, 0] @ W.mT).float())


def _stream(times: Tensor, joint: str, rows: np.ndarray, reference: Tensor, where: str) -> ImuStream:
    """One sensor in our world; its acceleration is that of rest where the specific force is gravity's."""
    R = (_WORLD_VICON.double() @ reference @ _rotations(rows[:, :4], where)).float()
    force, rate = (torch.tensor(rows[:, columns], dtype=torch.float32) for columns in (slice(4, 7), slice(7, 10)))
    free = (R @ force[..., None])[..., 0] - torch.tensor([0.0, 0.0, GRAVITY])
    left = free.mean(0).norm().item()
    if left > _TILT * GRAVITY:
        what = f"{left:.1f} m/s² are left on average without gravity"
        raise WearcapError(what, where, "the specific force in the sensor's axes (m/s²), and its orientation")
    return ImuStream(times, joint, R_world_imu=R, acc_world=free, acc_imu=force, gyro_imu=rate)


MOUNT_S, MOUNT_DEG = 1.0, 35.0
"""Time from a sequence's start in which sensors are calibrated to the body, as a calibration pose does; and the largest
median angle that is then between a sensor and the body (forearms bend against their hands)."""


def _read_folder(folder: Path) -> Recording:
    """A sequence in Vicon's skeleton; where the sensors are mounted is not known."""
    found = read_totalcapture(totalcapture_files(folder)[0])
    return Recording(folder.resolve().name, motion=found.motion, imu=found.imu, source="TotalCapture")


KINDS = (Kind("TotalCapture", _read_folder, knows=is_totalcapture),)
"""How `wearcap.read` knows the data set."""
VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


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


def totalcapture_tasks(
    source: str | Path,  # the folder that holds the subjects' folders, of Vicon and of the sensors
    splits: Splits,
    settings: MocapSettings = MOCAP,
    license: str = "TotalCapture licence (cvssp.org/data/totalcapture); not to be passed on",
) -> list[Task]:
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
        key = content_hash(asdict(about), asdict(settings), VERSION, *paths)
        tasks.append(Task(about.name, partial(_totalcapture, files, about, settings), splits.of(files.subject), key))
    return tasks
