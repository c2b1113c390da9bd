"""Nymeria and NymeriaPlus: Xsens body motion beside Project Aria's head trajectory and points, one folder per sequence.

The suit's data has its own clock and its own drifting world; both are aligned to the head device's
(nymeria_alignment.py), whose world is metric with z up.
"""

from functools import partial
from pathlib import Path

import numpy as np
import torch

from data_prep.aria_vrs import extract_video
from data_prep.nymeria_alignment import align_head, clock_offset
from data_prep.shared.engine import Splits, Task, changed, source_folder
from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.boundary.arrays import read_npz, require
from wearcap.boundary.opening import placed
from wearcap.boundary.texts import read_json_object
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate, nearest_frames, slerp
from wearcap.io.devices.aria_mps import (
    T_HEAD_DEVICE,
    find_mps_file,
    head_stream,
    mps_files,
    read_closed_loop,
    read_mps_points,
)
from wearcap.reading.kinds import Kind, below
from wearcap.recording import ContactTrack, HeadStream, Motion, Recording

SUIT_HZ = 240.0
_STEP_TOLERANCE_S = 1e-3
_DRIFT_TOLERANCE_S = 0.01
MAX_RESIDUAL_M = 0.25
"""Median distance (m) of the suit's aligned head and the device beyond which the alignment has failed."""


def is_nymeria(folder: str | Path) -> bool:
    """Whether a folder is a Nymeria sequence with body motion."""
    return (Path(folder) / "body" / "xdata.npz").is_file()


def head_vrs(folder: str | Path) -> Path:
    """Path of the head device's own recording, if it was downloaded."""
    return Path(folder) / "recording_head" / "data" / "data.vrs"


def read_xdata(path: str | Path) -> tuple[Motion, ContactTrack | None]:
    """Read `body/xdata.npz` as it is: the suit's own clock and world, 240 Hz, with its foot contacts.

    Time steps more than 1 ms off are replaced by the nominal one, zero quaternions by the previous one. Bone lengths are
    the median of the segments' distances. Raises WearcapError for missing or misshapen arrays, NaN, another frame rate, or cleaned
    timestamps that end more than 10 ms from the file's.
    """
    keys = ("timestamps_us", "segment_tXYZ", "segment_qWXYZ", "frameRate", "foot_contacts")
    arrays = read_npz(path, keys)
    count = len(xsens23())
    sizes = require(
        arrays, path, timestamps_us=("time",), segment_tXYZ=("time", 3 * count), segment_qWXYZ=("time", 4 * count)
    )
    if sizes["time"] < 2:
        raise WearcapError(f"{sizes['time']} frames", path, "at least 2")
    if "frameRate" in arrays and abs(float(arrays["frameRate"].reshape(-1)[0]) - SUIT_HZ) > 1:
        raise WearcapError(f"frame rate {arrays['frameRate'].reshape(-1)[0]}", path, f"{SUIT_HZ:g} Hz")
    seconds = arrays["timestamps_us"].astype(np.float64) * 1e-6
    steps = np.diff(seconds)
    steps[np.abs(steps - 1 / SUIT_HZ) > _STEP_TOLERANCE_S] = 1 / SUIT_HZ
    timestamps = seconds[0] + np.concatenate([[0.0], steps.cumsum()])
    if abs(timestamps[-1] - seconds[-1]) > _DRIFT_TOLERANCE_S:
        what = f"after cleaning, time ends {timestamps[-1] - seconds[-1]:+.3f} s from the file's own"
        raise WearcapError(what, path, f"steady {SUIT_HZ:g} Hz", "Frames were lost: cut the sequence there.")
    quat = arrays["segment_qWXYZ"].reshape(-1, count, 4).astype(np.float64)
    # Zeros become the same segment's previous quaternion (at the beginning: no rotation).
    latest = np.where(np.linalg.norm(quat, axis=-1) < 0.5, -1, np.arange(len(quat))[:, None])
    latest = np.maximum.accumulate(latest, axis=0)
    quat = np.take_along_axis(quat, np.maximum(latest, 0)[..., None], axis=0)
    quat[latest < 0] = (1.0, 0.0, 0.0, 0.0)
    R_world_joint = rotation.matrix_from_quat_wxyz(torch.from_numpy(quat))
    position = torch.from_numpy(arrays["segment_tXYZ"].reshape(-1, count, 3).astype(np.float64))
    # The wearer's bone offsets (m): each segment's origin in its parent's axes, the median over a thousand frames
    skeleton = xsens23()
    frames = torch.linspace(0, len(position) - 1, min(len(position), 1000)).long()
    parents = list(skeleton.parents[1:])
    apart = position[frames][:, 1:] - position[frames][:, parents]
    offsets = (R_world_joint[frames][:, parents].mT @ apart[..., None])[..., 0].median(0).values
    skeleton = skeleton.with_offsets(torch.cat([torch.zeros(1, 3), offsets.float()]))
    motion = Motion(
        torch.from_numpy(timestamps),
        skeleton,
        local_rotations(skeleton, R_world_joint).float(),
        position[:, 0].float(),
        provenance={"source": Path(path).name, "format": "nymeria"},
    )
    contact = arrays.get("foot_contacts")
    if contact is None:
        return motion, None
    if contact.shape != (len(motion), len(FOOT_PATCHES)):
        expected = f"({len(motion)}, {len(FOOT_PATCHES)})"
        raise WearcapError(f"foot_contacts has shape {contact.shape}", path, expected)
    return motion, ContactTrack(motion.timestamps, FOOT_PATCHES, torch.from_numpy(contact > 0.5))


def read_nymeria(folder: str | Path, *, fps: float = 60.0, video: Path | None = None) -> Recording:
    """Recording of one sequence folder: head stream, points, and the suit's motion in the head device's world and clock.

    All streams at `fps` (Hz) on the device's clock, cut to what suit and device share. The offset of the
    suit's clock (time code) is found by correlating head turns, to a few milliseconds.
    With `video`, the head's colour camera (`recording_head/data/data.vrs`) is written there as an MP4, undistorted and
    upright; that needs projectaria-tools. Raises WearcapError when a part is missing or suit and device cannot be aligned.
    """
    folder = Path(folder)
    slam = folder / "recording_head" / "mps" / "slam"
    path = find_mps_file(slam, ("closed_loop_trajectory.csv",))
    if path is None or not is_nymeria(folder):
        expected = "body/xdata.npz and recording_head/mps/slam/closed_loop_trajectory.csv"
        raise WearcapError("not a complete Nymeria sequence", folder, expected)
    suit, contacts = read_xdata(folder / "body" / "xdata.npz")
    device = head_stream(read_closed_loop(path)[0], fps=None)
    with placed(folder):
        motion, contact, head = _on_device(suit, contacts, device, fps)
    about, camera = read_metadata(folder), None
    if video is not None:
        between = (head.timestamps[0].item(), head.timestamps[-1].item())
        T_head_device = Rigid(head.R_head_device, head.t_head_device)
        camera = extract_video(head_vrs(folder), video, between=between, T_head_device=T_head_device)
    return Recording(
        name=folder.resolve().name,
        head=head,
        motion=motion,
        contacts=contact,
        camera=camera,
        skeleton=motion.skeleton,
        points=read_mps_points(slam),
        source="Nymeria",
        license="Nymeria dataset licence",
        **about,
    )


def _on_device(
    suit: Motion, contacts: ContactTrack | None, device: HeadStream, fps: float
) -> tuple[Motion, ContactTrack | None, HeadStream]:
    """Suit motion and contacts in the device's world, clock and rate, and the head stream on the same frames."""
    T_suit_head = suit.joint("head")
    track = Trajectory(device.timestamps, device.R_world_device, device.t_world_device)
    own = Trajectory(suit.timestamps, T_suit_head.R, T_suit_head.t)
    offset = clock_offset(own, track)
    own = Trajectory(own.timestamps + offset, own.R_world_body, own.t_world_body)
    alignment = align_head(own, track, T_HEAD_DEVICE.t)
    if alignment.residual_m > MAX_RESIDUAL_M:
        what = f"the suit's head stays {100 * alignment.residual_m:.0f} cm from the device after alignment"
        raise WearcapError(what, expected="suit and device of the same wearer on one clock")
    start = max(own.timestamps[0].item(), track.timestamps[0].item())
    stop = min(own.timestamps[-1].item(), track.timestamps[-1].item())
    times = start + torch.arange(int((stop - start) * fps) + 1, dtype=torch.float64) / fps
    T_world_root = alignment.T_world_suit @ Rigid(suit.R_parent_joint[:, 0].double(), suit.t_world_root.double())
    R = torch.cat([T_world_root.R[:, None].float(), suit.R_parent_joint[:, 1:]], 1)
    about = {"clock_offset_s": f"{offset:.4f}", "head_residual_m": f"{alignment.residual_m:.4f}"}
    about["head_residual_deg"] = f"{np.degrees(alignment.residual_rad):.2f}"
    motion = Motion(
        times,
        suit.skeleton,
        slerp(own.timestamps, R, times),
        interpolate(own.timestamps, T_world_root.t, times).float(),
        provenance=suit.provenance | about,
    )
    contact = None
    if contacts is not None:
        contact = ContactTrack(times, contacts.parts, contacts.contact[nearest_frames(own.timestamps, times)])
    R_world_device = slerp(track.timestamps, track.R_world_body, times)
    t_world_device = interpolate(track.timestamps, track.t_world_body, times)
    T_head_device = alignment.T_head_device
    return motion, contact, HeadStream(times, R_world_device, t_world_device, T_head_device.R, T_head_device.t)


def read_metadata(folder: Path) -> dict:
    """Subject, location, activity and size from metadata.json if present, else the subject from the folder's name."""
    parts = folder.resolve().name.split("_")
    about: dict = {"subject": "_".join(parts[2:4]) if len(parts) > 4 else "", "location": "", "activity": ""}
    path = folder / "metadata.json"
    if not path.is_file():
        return about
    content = read_json_object(path)
    about["subject"] = str(content.get("participant_id") or content.get("fake_name") or about["subject"])
    about["location"] = str(content.get("location", ""))
    about["activity"] = str(content.get("script", ""))
    size = {"height": ("participant_height_cm", 0.01), "weight": ("participant_weight_kg", 1.0)}
    about["shape"] = {
        name: float(content[key]) * unit
        for name, (key, unit) in size.items()
        if isinstance(content.get(key), int | float)
    }
    return about


KINDS = (
    Kind("Nymeria", read_nymeria, knows=is_nymeria),
    Kind("Nymeria's suit", lambda path: read_xdata(path)[0], (".npz",), lambda path: path.name == "xdata.npz"),
)
"""How `wearcap.read` knows the data set."""
VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


def nymeria_tasks(
    source: str | Path,  # the folder that holds the sequences' folders
    splits: Splits,
    fps: float | int = 60.0,
    license: str = "Nymeria dataset licence; not to be passed on",
    # video of the head camera, 256x256 pixels, for sequences with recording_head/data/data.vrs: output/videos (needs
    # wearcap[aria])
    camera: bool = False,
    output: str = ".",
) -> list[Task]:
    """One task per sequence folder (with `body/xdata.npz`) below `source`; hashed by its motion, head path and points.

    With `camera`, the video of the head's colour camera is written to `output`/videos, for sequences with `data.vrs`.
    """
    source = source_folder(source)
    folders = list(below(source, KINDS[:1]))
    if not folders:
        raise WearcapError("no sequences", where=source, expected="folders with body/xdata.npz")
    tasks = []
    for folder in folders:
        name, about, vrs = folder.resolve().name, read_metadata(folder), head_vrs(folder)
        video = Path(output) / "videos" / f"{name}.mp4" if camera and vrs.is_file() else None
        files = [folder / "body" / "xdata.npz", *mps_files(folder / "recording_head")]
        filmed_bytes = vrs.stat().st_size if video else 0
        key = content_hash(name, float(fps), VERSION, about, *files, filmed_bytes)
        read = partial(read_nymeria, folder, fps=float(fps), video=video)
        tasks.append(Task(name, partial(changed, read, name=name, license=license), splits.of(about["subject"]), key))
    return tasks
