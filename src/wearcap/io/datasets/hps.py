"""Single files of the HPS data set: SMPL motion, betas, camera localisation, starts, head cameras.

`hps_smpl/*.pkl` is in the scan's world (metres, z up) with joint frames of SMPL's (x left, y up, z forward), as AMASS
is. Localisation is the pose of the OpenCV camera in that world. io/datasets/hps_sequence.py puts a sequence together.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeletons import smpl24
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.io.formats.json_text import read_json_object
from wearcap.io.formats.npz import require
from wearcap.io.formats.poses import NORM_TOLERANCE
from wearcap.io.formats.restricted_pickle import read_pickle
from wearcap.io.formats.smpl_axes import rotations_from_smpl
from wearcap.recording import Localization, Motion

FPS = 30.0
"""Frame rate (Hz) of the motion, the suit's exports and the localised video (resampled from 29.97)."""
IMAGE_SIZE = (1920, 1080)
"""Width and height of the head cameras' videos."""
PELVIS_SMPL = (-0.0018, -0.2233, 0.0282)
"""Pelvis of SMPL's mean template in SMPL's axes (m); a person's own differs by a few centimetres with the betas."""
MAX_FRAMES = 1_000_000
"""Most frames (nine hours) that a file's frame numbers may span; frames that are not listed are filled in."""


@dataclass(frozen=True)
class HpsSubject:
    """A subject's body: SMPL betas and gender, and the height of the pelvis above the heels (m; 0 when not given)."""

    betas: tuple[float, ...]
    gender: str
    root_to_heel_m: float


def read_hps_motion(path: str | Path, t_template_pelvis: tuple[float, float, float] = PELVIS_SMPL) -> Motion:
    """Read `hps_smpl/*.pkl` {poses (T, 72), transes (T, 3)} as a smpl24 motion at 30 Hz that begins at 0 s.

    `t_template_pelvis` is the pelvis of the subject's SMPL template, where the user's body model gives it. Raises
    WearcapError for anything but arrays in the pickle (which is never run), missing or misshapen arrays, NaN, no frames.
    """
    content = read_pickle(path)
    if not isinstance(content, dict):
        raise WearcapError(f"it holds a {type(content).__name__}", where=path, expected="a dict of poses and transes")
    arrays = {key: np.asarray(content[key]) for key in ("poses", "transes") if key in content}
    sizes = require(arrays, path, poses=("time", 72), transes=("time", 3))
    if not sizes["time"]:
        raise WearcapError("no frames", where=path)
    R = rotations_from_smpl(torch.from_numpy(arrays["poses"].astype(np.float64)).unflatten(1, (-1, 3)))
    t = torch.from_numpy(arrays["transes"].astype(np.float64)) + torch.tensor(t_template_pelvis, dtype=torch.float64)
    times = torch.arange(sizes["time"], dtype=torch.float64) / FPS
    return Motion(times, smpl24(), R.float(), t.float(), provenance={"source": Path(path).name, "format": "hps"})


def read_hps_subject(path: str | Path) -> HpsSubject:
    """Read `hps_betas/SUBx.json`. Raises WearcapError for missing betas or what is no number."""
    content = read_json_object(path)
    try:
        betas = np.asarray(content["betas"], np.float64).reshape(-1)
        heel_m = float(content.get("root_to_heel", 0.0))
    except (KeyError, ValueError, TypeError) as error:
        raise WearcapError(
            f"no betas that can be read ({error})",
            where=path,
            expected='{"betas": 10 numbers, "gender": …, "root_to_heel": …}',
        ) from error
    if not (0 < len(betas) <= 300 and np.isfinite(betas).all() and np.isfinite(heel_m)):
        raise WearcapError(f"{len(betas)} betas, or some that are not finite", where=path, expected="10 numbers")
    return HpsSubject(tuple(betas.tolist()), str(content.get("gender", "neutral")), heel_m)


def read_hps_starts(path: str | Path) -> tuple[int, int]:
    """(frame of the localised video, frame of the suit) that show the same clap: `hps_inits/*.json`."""
    content = read_json_object(path)
    starts = [content.get(key) for key in ("cam_start", "imu_start")]
    if not all(isinstance(start, int | float) and 0 <= start <= MAX_FRAMES for start in starts):
        raise WearcapError(f"starts {starts}", where=path, expected='{"cam_start": frame, "imu_start": frame}, from 0')
    return int(starts[0]), int(starts[1])  # pyright: ignore[reportArgumentType]


def read_hps_localization(path: str | Path, fps: float | int = FPS) -> Localization:
    """Read `head_camera_localizations/*.json` {frame: {position, quaternion (w x y z)} or null}, frame 0 at 0 s.

    Frames that are null or absent have confidence 0, an identity rotation and position 0; the others confidence 1, for
    the file has no others. Raises WearcapError naming the frame for what is no pose, and when no frame has one.
    """
    rows = read_json_object(path)
    frames = _frame_numbers(rows, path)
    count = max(frames.values(), default=-1) + 1
    quat_wxyz, position = np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3))
    confidence = torch.zeros(count)
    for key, frame in frames.items():
        if rows[key] is not None:
            quat_wxyz[frame], position[frame] = read_hps_pose(rows[key], f"{path}, frame {key}")
            confidence[frame] = 1.0
    if not confidence.any():
        raise WearcapError("no frame has a pose", where=path, expected="poses of some frames, null for the others")
    return Localization(
        torch.arange(count, dtype=torch.float64) / fps,
        rotation.matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz)).float(),
        torch.from_numpy(position).float(),
        confidence,
    )


def _frame_numbers(rows: dict[str, Any], path: str | Path) -> dict[str, int]:
    frames = {}
    for key in rows:
        if not (key.isascii() and key.isdigit() and len(key) < 20 and int(key) < MAX_FRAMES):
            raise WearcapError(f"frame {key[:30]!r}", where=path, expected="frame numbers from 0 as keys")
        frames[key] = int(key)
    if len(set(frames.values())) < len(frames):
        raise WearcapError("a frame is there twice", where=path)
    return frames


def read_hps_pose(row: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """(quaternion w x y z, position) of {"position": …, "quaternion": …}; anything else raises WearcapError."""
    try:
        quat_wxyz = np.asarray(row["quaternion"], np.float64).reshape(4)
        position = np.asarray(row["position"], np.float64).reshape(3)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise WearcapError(
            f"no pose ({type(error).__name__}: {error})",
            where=where,
            expected='{"position": [x, y, z], "quaternion": [w, x, y, z]}',
        ) from error
    if not (np.abs(position) < 1e6).all() or not abs(np.linalg.norm(quat_wxyz) - 1) < NORM_TOLERANCE:
        raise WearcapError(
            f"position {position.tolist()}, quaternion {quat_wxyz.tolist()}",
            where=where,
            expected="metres, and a quaternion of length 1",
        )
    return quat_wxyz, position


def read_hps_cameras(path: str | Path) -> dict[str, Camera]:
    """Head cameras by video (name without suffix) of `head_camera_videos/cameras.json`: OpenCV's model, 1920x1080.

    Raises WearcapError naming the camera for missing or wrong parameters.
    """
    cameras: dict[str, Camera] = {}
    for serial, row in read_json_object(path).items():
        where = f"{path}, camera {serial!r}"
        try:
            lens = row["parameters"]
            focal, centre, distortion = (
                np.asarray(lens[key], np.float64).reshape(-1).tolist()
                for key in ("focal_dist_xy", "center_xy", "dist_coeffs")
            )
            videos = [Path(str(video)).stem for video in row["captured_videos"]]
            if not (len(focal) == len(centre) == 2 and np.isfinite([*focal, *centre, *distortion]).all()):
                raise ValueError(f"focal lengths {focal}, centre {centre}, distortion {distortion}")
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise WearcapError(
                f"no intrinsics ({type(error).__name__}: {error})"[:200],
                where=where,
                expected="parameters {focal_dist_xy, center_xy, dist_coeffs} and captured_videos",
            ) from error
        distortion = tuple((distortion + [0.0] * 4)[: max(4, len(distortion))])
        try:
            camera = Camera("opencv", *IMAGE_SIZE, *focal, *centre, distortion)
        except WearcapError as error:
            raise WearcapError(error.what, where=where, expected=error.expected) from error
        cameras |= dict.fromkeys(videos, camera)
    return cameras


def resampled_localization(localization: Localization, fps: float | int) -> Localization:
    """Poses at another rate: slerp and lerp between two localised frames, else confidence 0; covariances are dropped."""
    old = localization.timestamps
    count = int((old[-1] - old[0]).item() * fps + 1e-6) + 1
    times = old[0] + torch.arange(count, dtype=torch.float64) / fps
    after = torch.searchsorted(old, times).clamp(max=len(old) - 1)
    before = (after - 1).clamp(min=0)
    blend = ((times - old[before]) / (old[after] - old[before]).clamp(min=1e-9)).clamp(0, 1).float()
    # A frame that nearly coincides with an old one uses that one alone: the next may have no pose to interpolate with.
    blend = torch.where(blend < 1e-3, 0.0, torch.where(blend > 1 - 1e-3, 1.0, blend))
    sure = torch.minimum(localization.confidence[before], localization.confidence[after])
    sure = torch.where(blend == 0, localization.confidence[before], sure)
    sure = torch.where(blend == 1, localization.confidence[after], sure)
    R, t = localization.R_world_cam, localization.t_world_cam
    turn = rotation.exp(blend[:, None] * rotation.log(R[before].mT @ R[after]))
    found = (sure > 0)[:, None]
    return Localization(
        times,
        torch.where(found[..., None], R[before] @ turn, torch.eye(3)),
        torch.where(found, torch.lerp(t[before], t[after], blend[:, None]), torch.zeros(3)),
        sure,
    )


def nominal_mount() -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """(R_head_cam, t_head_cam) of an upright, forward-looking camera on the forehead (assumed: it is not measured)."""
    return torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), torch.tensor([0.12, 0.0, 0.12])
