"""Aria Digital Twin (ADT) sequences: head trajectory, tracked body joints and objects from CSV and JSON files.

The files' world has y up (gravity along -y; sequences of version 1 may have z up); here it is turned to z up, x staying x.
"""

from pathlib import Path

import numpy as np
import torch

from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json_object
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.aria_mps import head_stream, read_closed_loop
from wearcap.io.devices.axes import WORLDS
from wearcap.io.formats.csv_table import read_columns
from wearcap.io.formats.poses import check_finite, check_rising, checked_trajectory
from wearcap.reading.kinds import Kind
from wearcap.recording import Cue, Recording

_BODY = {
    "pelvis": 0, "t8": 2, "neck": 3, "head": 4, "left_shoulder": 6, "left_elbow": 7, "left_wrist": 8,
    "right_shoulder": 25, "right_elbow": 26, "right_wrist": 27, "left_hip": 43, "left_knee": 44, "left_ankle": 45,
    "left_toe": 46, "right_hip": 47, "right_knee": 48, "right_ankle": 49, "right_toe": 50,
}  # fmt: skip
"""Row of each joint among the file's 51 joints (Skeleton, Ab, Chest, Neck, Head, LShoulder, LUArm, LFArm, LHand, 15 fingers …)."""
_JOINTS = 51


def is_adt(folder: str | Path) -> bool:
    """Whether a folder holds an ADT sequence."""
    return (Path(folder) / "aria_trajectory.csv").is_file()


def read_adt(folder: str | Path) -> Recording:
    """Recording of an ADT sequence folder: head stream (30 Hz), 3D cues of body joints, moving objects.

    Joints are positions only (cues, confidence 1), for the file has no rotations. Raises WearcapError for missing or
    malformed files.
    """
    folder = Path(folder)
    if not is_adt(folder):
        raise WearcapError("no aria_trajectory.csv", folder, "an ADT sequence folder")
    path = read_closed_loop(folder / "aria_trajectory.csv")
    skeletons = sorted(folder.glob("Skeleton_*.json"))
    metadata = folder / "metadata.json"
    return Recording(
        name=folder.resolve().name,
        head=head_stream(path.trajectory, fps=None, where=folder),
        cues=read_skeleton(skeletons[0], path.up) if skeletons else {},
        object_motion=read_moving_objects(folder, path.up) if (folder / "scene_objects.csv").is_file() else {},
        location=str(read_json_object(metadata).get("scene", "")) if metadata.is_file() else "",
        source="Aria Digital Twin",
    )


def read_skeleton(path: str | Path, up: str = "y") -> dict[str, Cue]:
    """3D cues by joint name from `Skeleton_*.json` (120 Hz). Raises WearcapError for other joint counts or NaN."""
    with understood("not an ADT skeleton", path, "frames with timestamp_ns and joints"):
        frames = read_json_object(path)["frames"]
        times = np.array([frame["timestamp_ns"] for frame in frames], dtype=np.float64) * 1e-9
        joints = np.array([frame["joints"] for frame in frames], dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] != (_JOINTS, 3):
        raise WearcapError(f"joints of shape {joints.shape}", path, f"(frames, {_JOINTS}, 3)")
    check_finite({"joints": joints}, path)
    check_rising(times, path)
    world = torch.tensor(joints, dtype=torch.float32) @ WORLDS[up].T
    timestamps, sure = torch.from_numpy(times), torch.ones(len(times))
    return {name: Cue(timestamps, name, world[:, row], sure) for name, row in _BODY.items()}


def read_moving_objects(folder: str | Path, up: str = "y") -> dict[str, Trajectory]:
    """Poses of the objects that move, in the z-up world, from instances.json, 3d_bounding_box.csv and scene_objects.csv.

    Raises WearcapError for missing or malformed files; objects without a pose or box are left out, as are those with a
    timestamp of -1, whose pose is for all time.
    """
    folder = Path(folder)
    path = folder / "scene_objects.csv"
    axes = [f"t_wo_{axis}[m]" for axis in "xyz"] + [f"q_wo_{axis}" for axis in "wxyz"]
    poses = read_columns(path, axes, text=["object_uid", "timestamp[ns]"])
    extents = [f"p_local_obj_{axis}{end}[m]" for end in ("min", "max") for axis in "xyz"]
    boxes = set(read_columns(folder / "3d_bounding_box.csv", extents, text=["object_uid"])["object_uid"].tolist())
    instances = read_json_object(folder / "instances.json")
    order = np.argsort(poses["object_uid"], kind="stable")
    found = {}
    for rows in np.split(order, np.unique(poses["object_uid"][order], return_index=True)[1][1:]):
        uid = bytes(poses["object_uid"][rows[0]])
        name = uid.decode("latin-1")
        about = instances.get(name)
        if about is None or uid not in boxes:
            continue
        if not isinstance(about, dict):
            expected = "its instance_name, category and motion_type"
            raise WearcapError(f"object {name} is a {type(about).__name__}", folder / "instances.json", expected)
        with understood("a time is no number", path, "nanoseconds, or -1"):
            times = poses["timestamp[ns]"][rows].astype(np.float64) * 1e-9
        timeless = bool((times < 0).any())
        last = 1 if timeless else len(rows)
        table = np.stack([poses[axis][rows] for axis in axes], 1)[:last]
        track = checked_trajectory(times[:last], table[:, :3], table[:, 3:], path)
        T_world_obj = Rigid(WORLDS[up], torch.zeros(3)) @ track.T_world_body
        if about.get("motion_type") == "dynamic" and not timeless:
            found[str(about.get("instance_name", name))] = Trajectory(track.timestamps, T_world_obj.R, T_world_obj.t)
    return found


KINDS = (Kind("ADT", read_adt, knows=is_adt),)
"""How `wearcap.read` knows the data set, which has no true body to prepare."""
