"""TotalCapture as it unpacks (Vicon's ground truth and the Xsens sensors with AuxFields, below s1 … s5); bring your own download."""

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import roma
import torch

from data_prep.shared.engine import NOTE, Splits, Task, source_folder
from data_prep.shared.mocap import MOCAP, About, MocapSettings, mocap_recording, on_xsens23, without_glitches
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.io.datasets.totalcapture import TotalCaptureFiles, read_totalcapture, totalcapture_files
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ImuStream, Recording

MOUNT_S, MOUNT_DEG = 1.0, 35.0
"""Time from a sequence's start in which sensors are calibrated to the body, as a calibration pose does; and the largest
median angle that is then between a sensor and the body (forearms bend against their hands)."""


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
