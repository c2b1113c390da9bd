"""One sequence of the HPS data set: published motion, suit, head camera, localisation and scan on one clock.

Folders are found by what their names contain (`hps_smpl`, `hps_betas`, `hps_inits`, `head_camera_localizations`,
`head_camera_videos`, any with `NAME_pose.txt` or `NAME.mvnx`), so that renamed ones are found too. Time 0 is the clap:
`cam_start` of the localised video, `imu_start` of the suit, and the published motion's first frame.
"""

import re
import warnings
from dataclasses import replace
from glob import escape
from pathlib import Path

import torch

from wearcap.errors import WearcapError
from wearcap.io.datasets.hps import (
    CLOUD,
    FPS,
    IMAGE_SIZE,
    nominal_mount,
    read_hps_cameras,
    read_hps_localization,
    read_hps_motion,
    read_hps_starts,
    read_hps_subject,
    read_unity_motion,
)
from wearcap.io.formats.mvnx import read_mvnx
from wearcap.io.formats.video import video_info
from wearcap.recording import CameraStream, ImuStream, Localization, Motion, Recording

_SUBJECT = re.compile(r"SUB\d+")
_SCAN_OF = {
    "SUB1": "MPI_BIBLIO_EG",
    "SUB2": "MPI_EG",
    "SUB3": "MPI_KINO",
    "SUB4": "MPI_Etage6",
    "SUB5": "MPI_GEB_AB",
    "SUB6": "MPI_BIBLIO_UG",
    "SUB7": "MPI_BIBLIO_OG",
}
"""Scan of each subject's sequences, except those that `_scan_name` handles individually."""
FAR_M = 2.0
"""Median distance (m) of pelvis and localised camera beyond which clocks or places of the two disagree."""


def is_hps(folder: str | Path) -> bool:
    """Whether a folder holds the HPS data set's motions."""
    return any(True for _ in Path(folder).glob("*hps_smpl*/*.pkl"))


def hps_names(root: str | Path) -> list[str]:
    """Names of all sequences with published motion, in order."""
    return sorted(path.stem for path in Path(root).glob("*hps_smpl*/*.pkl"))


def subject_of(name: str) -> str:
    """SUB1…SUB7. Raises WearcapError when the name holds none."""
    found = _SUBJECT.search(name)
    if found is None:
        raise WearcapError(f"sequence {name!r} names no subject", expected="a name with SUB1 … SUB7")
    return found.group()


def _scan_name(name: str) -> str:
    """Scan that a sequence was recorded in, as assigned by the published code."""
    subject = subject_of(name)
    if "double" in name.lower():
        return "MPI_EG"
    if subject == "SUB1" and "exercises" in name.lower():
        return "MPI_BIB_AB_SEND"
    return _SCAN_OF.get(subject, "")


def read_hps_sequence(root: str | Path, name: str, camera_hz: float | int = FPS) -> Recording:
    """Read a sequence: `motion` (the published result, smpl24) and, where present, `suit` (MVNX with contacts and `imu`,
    else Unity's text), `localization`, `camera` (video and scan by absolute path) and `scene`.

    `camera_hz` is the rate of the video that was localised: 30, or 29.97 where it was not resampled. Raises WearcapError
    when there is no such sequence, no starts for streams that need them, no intrinsics for its video, and for what the
    files' readers refuse; warns when motion and camera are apart.
    """
    root = Path(root)
    if not name or Path(name).name != name or escape(name) != name:
        expected = "a plain name, such as SUB4_MPI_Etage6_working_standing"
        raise WearcapError(f"no sequence {name!r}", where=root, expected=expected)
    motion_path = _one(root, f"*hps_smpl*/{name}.pkl")
    if motion_path is None:
        known = hps_names(root)
        expected = f"one of {len(known)}, such as {known[:3]}" if known else "hps_smpl/NAME.pkl"
        raise WearcapError(f"no sequence {name!r}", where=root, expected=expected)
    motion = read_hps_motion(motion_path)
    subject, shape = _one(root, f"*betas*/{subject_of(name)}.json"), {}
    if subject is not None:
        shape, about = read_hps_subject(subject)
        motion = replace(motion, provenance=motion.provenance | about)
    localization_path = _one(root, f"*locali*/{name}.json")
    suit = _suit(root, name)
    starts = _one(root, f"*init*/{name}.json")
    if starts is None and (localization_path is not None or suit is not None):
        fix = "Without them its streams' clocks are unknown."
        raise WearcapError(f"no starts of sequence {name!r}", where=root, expected=f"hps_inits/{name}.json", fix=fix)
    cam_start, imu_start = (0, 0) if starts is None else read_hps_starts(starts)
    localization = None
    if localization_path is not None:
        localization = read_hps_localization(localization_path, camera_hz)
        if cam_start >= len(localization.timestamps):
            what = f"cam_start {cam_start} is beyond the {len(localization.timestamps)} localised frames"
            raise WearcapError(what, where=starts)
        localization = replace(localization, timestamps=localization.timestamps - cam_start / camera_hz)
        _warn_if_apart(motion, localization, motion_path)
    scan = _one(root, *(f"{depth}{_scan_name(name)}/{CLOUD}" for depth in ("", "*/", "*/*/")))
    recording = Recording(
        name,
        motion=motion,
        localization=localization,
        skeleton=motion.skeleton,
        shape=shape,
        camera=_camera(root, name, cam_start / camera_hz, localization),
        subject=subject_of(name),
        location=_scan_name(name),
        activity=name.removeprefix(f"{subject_of(name)}_").removeprefix(f"{_scan_name(name)}_"),
        scene=None if scan is None else str(scan.resolve()),
        source="HPS data set",
    )
    if suit is None:
        return recording
    motion, imu = suit
    if imu_start >= len(motion):
        raise WearcapError(f"imu_start {imu_start} is beyond the suit's {len(motion)} frames", where=name)
    clap_s = motion.timestamps[imu_start]
    imu = {joint: replace(stream, timestamps=stream.timestamps - clap_s) for joint, stream in imu.items()}
    return replace(recording, suit=replace(motion, timestamps=motion.timestamps - clap_s), imu=imu)


def _one(root: Path, *patterns: str) -> Path | None:
    return next((path for pattern in patterns for path in sorted(root.glob(pattern))), None)


def _suit(root: Path, name: str) -> tuple[Motion, dict[str, ImuStream]] | None:
    """The suit's motion and sensors on its own clock."""
    mvnx = _one(root, f"*/{name}.mvnx", f"*/{name}.mvnx.gz")
    if mvnx is not None:
        read = read_mvnx(mvnx)
        assert read.motion is not None
        return read.motion, read.imu
    pose, trans = _one(root, f"*/{name}_pose.txt"), _one(root, f"*/{name}_trans.txt")
    return None if pose is None or trans is None else (read_unity_motion(pose, trans), {})


def _camera(root: Path, name: str, clap_s: float, localization: Localization | None) -> CameraStream | None:
    path = _one(root, f"*video*/{name}.[mM][pP]4")
    calibration = _one(root, "*video*/cameras.json", "cameras.json")
    if calibration is None:
        return None
    cameras = read_hps_cameras(calibration)
    if name not in cameras:
        expected = f"its name among captured_videos (there are {len(cameras)})"
        raise WearcapError(f"no intrinsics for the video of {name!r}", where=calibration, expected=expected)
    if path is None:
        return None if localization is None else CameraStream(localization.timestamps, cameras[name], *nominal_mount())
    video = video_info(path)
    if (video.width, video.height) != IMAGE_SIZE or not video.frames:
        what = f"a video of {video.frames} frames of {video.width}x{video.height} pixels"
        raise WearcapError(what, where=path, expected=f"{IMAGE_SIZE[0]}x{IMAGE_SIZE[1]}, as its camera was calibrated")
    times = torch.arange(video.frames, dtype=torch.float64) / video.fps - clap_s
    return CameraStream(times, cameras[name], *nominal_mount(), video=str(path.resolve()))


def _warn_if_apart(motion: Motion, localization: Localization, path: Path) -> None:
    frame = torch.searchsorted(motion.timestamps, localization.timestamps).clamp(max=len(motion) - 1)
    times = localization.timestamps
    localized = (localization.confidence > 0) & (times >= 0) & (times <= motion.timestamps[-1])
    if not localized.any():
        warnings.warn(f"{path}: no localised frame while the motion lasts", stacklevel=3)
        return
    apart = (motion.t_world_root[frame] - localization.t_world_cam)[localized].norm(dim=-1).median().item()
    if apart > FAR_M:
        warnings.warn(
            f"{path}: pelvis and localised camera are {apart:.1f} m apart (median): other clocks, or another scan",
            stacklevel=3,
        )
