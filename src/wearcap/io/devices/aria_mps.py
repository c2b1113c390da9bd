"""Project Aria's machine perception services (MPS): head trajectory, hands and semi-dense points from CSV files.

Frames: `aria` is MPS's own device frame (on Gen 1 glasses the left SLAM camera), `cpf` the central pupil frame
(x left, y up, z forward, midway between the pupils), `device` that same point with wearcap's head axes
(x forward, y left, z up), the frame of a `HeadStream`.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.io.devices.aria_hands import read_fingers, read_hands
from wearcap.io.devices.axes import WORLDS
from wearcap.io.formats.csv_table import iter_columns, read_columns, read_header
from wearcap.io.formats.poses import check_finite, checked_trajectory
from wearcap.recording import HeadStream, PointCloud, Recording

MAX_INV_DIST_STD, MAX_DIST_STD = 0.005, 0.01
"""Largest standard deviation (1/m, m) of semi-dense points; points with a larger one are dropped."""

T_HEAD_DEVICE = Rigid(torch.eye(3), torch.tensor([0.09, 0.0, 0.075]))
"""Default pose of the device on the head joint (assumed): the pupils' midpoint in front of and above it, axes parallel."""

_MAX_DURATION_S = 12 * 3600
R_CPF_DEVICE = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Head axes (x forward, y left, z up) in the central pupil frame (x left, y up, z forward)."""

_SUFFIXES = ("", ".gz", ".xz")
_TRAJECTORY = ("closed_loop_trajectory.csv",)
_POINTS = ("semidense_points.csv", "global_points.csv")
_OBSERVATIONS = ("semidense_observations.csv",)
_HAND_FOLDERS = ("", "hand_tracking/", "mps/hand_tracking/")
_HANDS = tuple(
    tuple(f"{part}{name}{version}.csv" for part in _HAND_FOLDERS for version in ("", "_v3", "_v2", "_v1"))
    for name in ("wrist_and_palm_poses", "hand_tracking_results")
)
_SUBFOLDERS = (".", "slam", "trajectory", "mps/slam", "mps/trajectory")


def nominal_T_aria_cpf() -> Rigid:
    """CAD pose of the central pupil frame in the device frame of Gen 1 glasses, small size ("DVT-S").

    The large size differs by 2.4 mm; a VRS file's calibration gives the wearer's own (data_prep/aria_vrs.py).
    Source: projectaria_tools, DeviceCadExtrinsics, row camera-slam-left (position, y axis, z axis in cpf).
    """
    y = torch.nn.functional.normalize(torch.tensor([0.793353, 0.0, -0.608761], dtype=torch.float64), dim=0)
    z = torch.nn.functional.normalize(torch.tensor([0.607927, -0.052336, 0.792266], dtype=torch.float64), dim=0)
    x = torch.linalg.cross(y, z)
    R_cpf_aria = torch.stack([x, torch.linalg.cross(z, x), z], 1)
    T_cpf_aria = Rigid(R_cpf_aria, torch.tensor([0.069051, 0.002372, 0.009254], dtype=torch.float64))
    return T_cpf_aria.inverse().to(torch.float32)


class ClosedLoop(NamedTuple):
    """A closed-loop trajectory in a world with z up."""

    trajectory: Trajectory
    """Poses of the `aria` frame."""
    quality: Float[Tensor, "time"]
    """MPS' score of each pose, 0 … 1."""
    up: str
    """The file's own axis that is up, by its gravity: "z", or "y" (ADT)."""


def read_closed_loop(path: str | Path) -> ClosedLoop:
    """Read `closed_loop_trajectory.csv` (plain, .gz, .xz), the world's axis that its gravity shows to be up turned to z.

    Raises WearcapError for missing columns, NaN, unsorted times, quaternions far from unit norm, gravity that points
    along neither -y nor -z, and several unconnected world frames.
    """
    header = read_header(path)
    pose = [f"{part}_world_device" for part in ("tx", "ty", "tz", "qw", "qx", "qy", "qz")]
    velocity = [f"device_linear_velocity_{axis}_device" for axis in "xyz"]
    spin = [f"angular_velocity_{axis}_device" for axis in "xyz"]
    old = "gravity_x" in header and "gravity_x_world" not in header  # before MPS 1.0
    gravity = [f"gravity_{axis}" if old else f"gravity_{axis}_world" for axis in "xyz"]
    time, quality = "tracking_timestamp_us", "quality_score"
    table = read_columns(path, [time, *pose, *velocity, *spin, *gravity, quality], text=["graph_uid"])
    columns = {
        key: np.stack([table[name] for name in names], 1)
        for key, names in {"pose": pose, "velocity": velocity, "spin": spin, "gravity": gravity}.items()
    }
    check_finite({**columns, quality: table[quality]}, path)
    if len(graphs := np.unique(table["graph_uid"])) > 1:
        what = f"{len(graphs)} unconnected world frames (graph_uid)"
        raise WearcapError(what, path, "one", "Keep the rows of one graph_uid.")
    measured = columns["gravity"]
    mean = measured.mean(0)
    length = np.linalg.norm(mean)
    if not 9.7 < length < 9.9:
        raise WearcapError(f"gravity is {length:.2f} m/s² long", path, "9.81 m/s²")
    upward = -mean / length
    up = "xyz"[int(upward.argmax())]
    if up == "x" or upward.max() < 0.99:
        fix = "Rotate the world, or fix gravity's sign."
        raise WearcapError(f"gravity points along {mean.round(2).tolist()}", path, "-z, or -y", fix)
    trajectory = checked_trajectory(table[time] * 1e-6, columns["pose"][:, :3], columns["pose"][:, 3:], path)
    T_turned = Rigid(WORLDS[up], torch.zeros(3)) @ trajectory.T_world_body
    turned = Trajectory(trajectory.timestamps, T_turned.R, T_turned.t)
    return ClosedLoop(turned, torch.tensor(table[quality], dtype=torch.float32), up)


def head_stream(
    trajectory: Trajectory, *, fps: float | None, T_aria_cpf: Rigid | None = None, where: str | Path | None = None
) -> HeadStream:
    """Head stream of a trajectory of the `aria` frame, turned to head axes at the pupils' midpoint.

    `fps` resamples evenly from the first timestamp (Hz; None keeps the file's 1 kHz). `T_aria_cpf` defaults to the
    nominal CAD pose. Raises WearcapError, naming `where`, for poses over more than half a day.
    """
    if fps is not None:
        start, stop = trajectory.timestamps[0].item(), trajectory.timestamps[-1].item()
        if stop - start > _MAX_DURATION_S:
            what = f"poses over {(stop - start) / 3600:.3g} hours"
            fix = "A time stamp is damaged, or two recordings stand in one file: cut it."
            raise WearcapError(what, where, "a recording of less than half a day", fix)
        count = int((stop - start) * fps + 1e-6) + 1
        trajectory = resample(trajectory, start + torch.arange(count, dtype=torch.float64) / fps)
    T_aria_cpf = T_aria_cpf or nominal_T_aria_cpf()
    T_world_device = trajectory.T_world_body @ T_aria_cpf @ Rigid(R_CPF_DEVICE, torch.zeros(3))
    return HeadStream(trajectory.timestamps, T_world_device.R, T_world_device.t, T_HEAD_DEVICE.R, T_HEAD_DEVICE.t)


def read_points(path: str | Path, observations: str | Path | None = None) -> PointCloud:
    """Reliable semi-dense points; their confidence is 1 - inv_dist_std / `MAX_INV_DIST_STD` (our choice), 0 … 1.

    `observations` is the file of observation times (`semidense_observations.csv`, tens of millions of rows, read in
    chunks): `first_seen` comes from it, and points without an observation are dropped.
    Raises WearcapError for missing columns or NaN positions, and for the observations of another recording.
    """
    position = [f"p{axis}_world" for axis in "xyz"]
    table = read_columns(path, [*position, "inv_dist_std", "dist_std"], integers=["uid"] if observations else [])
    points = np.stack([table[name] for name in position], 1)
    check_finite({"position": points}, path)
    keep = (table["inv_dist_std"] < MAX_INV_DIST_STD) & (table["dist_std"] < MAX_DIST_STD)
    first_seen = None
    if observations is not None:
        # Time of each point's first observation (s, the device's clock); infinite for points without one
        uid = table["uid"]
        order = np.argsort(uid, kind="stable")
        known = uid[order]
        first_us = np.full(len(uid), np.iinfo(np.int64).max)
        for rows in iter_columns(observations, [], integers=["uid", "frame_tracking_timestamp_us"]):
            place = np.minimum(np.searchsorted(known, rows["uid"]), len(known) - 1)
            named = known[place] == rows["uid"]
            np.minimum.at(first_us, place[named], rows["frame_tracking_timestamp_us"][named])
        if (first_us == np.iinfo(np.int64).max).all():
            raise WearcapError("names none of the points", observations, "the observations of the same recording")
        seen = np.empty(len(uid))
        seen[order] = np.where(first_us < np.iinfo(np.int64).max, first_us * 1e-6, np.inf)
        keep &= np.isfinite(seen)
        first_seen = torch.from_numpy(seen[keep])
    confidence = 1 - table["inv_dist_std"][keep] / MAX_INV_DIST_STD
    points_world = torch.tensor(points[keep], dtype=torch.float32)
    return PointCloud(points_world, torch.tensor(confidence, dtype=torch.float32), first_seen)


def find_mps_file(folder: str | Path, names: tuple[str, ...]) -> Path | None:
    """First of `names` (plain, .gz, .xz) in an MPS folder or its usual subfolders; None where there is none."""
    files = (Path(part) / f"{name}{suffix}" for part in _SUBFOLDERS for name in names for suffix in _SUFFIXES)
    return next((path for file in files if (path := Path(folder) / file).is_file()), None)


def is_mps_folder(folder: str | Path) -> bool:
    """Whether a folder holds a closed-loop trajectory."""
    return find_mps_file(folder, _TRAJECTORY) is not None


def read_mps(folder: str | Path, *, fps: float | None = 60.0, T_aria_cpf: Rigid | None = None) -> Recording:
    """Recording of an MPS output folder: head stream at `fps` (Hz) and, where there are any, points and tracked wrists.

    Raises WearcapError when there is no closed-loop trajectory, or a file is not as documented.
    """
    path = find_mps_file(folder, _TRAJECTORY)
    if path is None:
        what = "no closed_loop_trajectory.csv (plain, .gz or .xz)"
        raise WearcapError(what, folder, "the output folder of Aria's MPS")
    track = read_closed_loop(path).trajectory
    head = head_stream(track, fps=fps, T_aria_cpf=T_aria_cpf, where=path)
    files = _found(folder, *_HANDS)
    wrists, note = read_hands(files, track)
    name, points = Path(folder).resolve().name, read_mps_points(folder)
    first, last = track.timestamps[[0, -1]]
    fingers = {
        side: hand
        for side, hand in read_fingers(files).items()
        if (hand.valid & (hand.timestamps >= first) & (hand.timestamps <= last)).any()
    }
    return Recording(name, head, points=points, tracked=wrists, fingers=fingers, source="Aria MPS", note=note)


def read_mps_points(folder: str | Path) -> PointCloud | None:
    """Points of an MPS output folder, with the time of their first observation if that file exists."""
    points = find_mps_file(folder, _POINTS)
    if points is None:
        return None
    return read_points(points, find_mps_file(folder, _OBSERVATIONS))


def mps_files(folder: str | Path) -> list[Path]:
    """Files of a folder that `read_mps` reads."""
    return _found(folder, _TRAJECTORY, _POINTS, _OBSERVATIONS, *_HANDS)


def _found(folder: str | Path, *kinds: tuple[str, ...]) -> list[Path]:
    return [path for names in kinds if (path := find_mps_file(folder, names)) is not None]
