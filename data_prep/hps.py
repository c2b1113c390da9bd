"""Files of the HPS data set: SMPL motion, betas, camera localisation, starts, head cameras, scans, the suit's pose.

`hps_smpl/*.pkl` is in the scan's world (metres, z up) with joint frames of SMPL's (x left, y up, z forward), as AMASS
is. Localisation is the pose of the OpenCV camera in that world. `read_hps_sequence` puts a sequence on one
clock, whose time 0 is the clap: `cam_start` of the localised video, `imu_start` of the suit, and the published motion's first
frame. Its folders are found by what their names contain (`hps_smpl`, `hps_betas`, `hps_inits`, `head_camera_localizations`,
`head_camera_videos`, any with `NAME_pose.txt` or `NAME.mvnx`), so that renamed ones are found too.

The suit's pose is text written by Unity (`*_pose.txt`, `*_trans.txt`), whose world is left-handed (x right, y up, z
forward) and turns by Euler angles "ZXY": first about z, then x, then y, all about fixed axes, in degrees. With x flipped
it is SMPL's (right-handed): rotations about x keep their sign, those about y and z change it, so
R = Ry(-y) Rx(x) Rz(-z). SMPL's axes are then converted as in wearcap.io.formats.amass; here the world's axes are, too, for
Unity's world is y up.
"""

import re
import warnings
from array import array
from dataclasses import replace
from functools import partial
from glob import escape
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.shared.engine import Splits, Task, source_folder
from wearcap.body.skeletons import smpl24
from wearcap.boundary.arrays import array_of, require
from wearcap.boundary.opening import placed, understood
from wearcap.boundary.pickles import read_pickled_dict
from wearcap.boundary.texts import at_line, finite_floats, numbered_lines, read_json_object
from wearcap.checks.consistency import check_files
from wearcap.checks.report import Finding
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rotation import about_axis
from wearcap.io.devices.axes import CAMERA
from wearcap.io.formats.mvnx import read_mvnx
from wearcap.io.formats.navvis import CLOUD, read_pose
from wearcap.io.formats.smpl import A, shape_from_betas, smpl_motion
from wearcap.io.formats.video import video_info
from wearcap.reading.kinds import Kind
from wearcap.recording import CameraStream, ImuStream, Localization, Motion, Recording
from wearcap.recording.timing import resampled

FPS = 30.0
"""Frame rate (Hz) of the motion, the suit's exports and the localised video (resampled from 29.97)."""
IMAGE_SIZE = (1920, 1080)
"""Width and height of the head cameras' videos."""
PELVIS_SMPL = (-0.0018, -0.2233, 0.0282)
"""Pelvis of SMPL's mean template in SMPL's axes (m); a person's own differs by a few centimetres with the betas."""
MAX_FRAMES = 1_000_000
"""Most frames (nine hours) that a file's frame numbers may span; frames that are not listed are filled in."""


def read_hps_motion(path: str | Path) -> Motion:
    """Read `hps_smpl/*.pkl` {poses (T, 72), transes (T, 3)} as a smpl24 motion at 30 Hz that begins at 0 s.

    Raises WearcapError for anything but arrays in the pickle (which is never run), missing or misshapen arrays, NaN,
    and no frames.
    """
    content = read_pickled_dict(path, "a dict of poses and transes")
    arrays = {key: array_of(content[key], f"{path}, {key!r}") for key in ("poses", "transes") if key in content}
    sizes = require(arrays, path, poses=("time", 72), transes=("time", 3))
    if not sizes["time"]:
        raise WearcapError("no frames", path)
    times, pelvis = torch.arange(sizes["time"], dtype=torch.float64) / FPS, arrays["transes"].astype(np.float64)
    about = {"source": Path(path).name, "format": "hps"}
    return smpl_motion(times, smpl24(), arrays["poses"], pelvis + PELVIS_SMPL, **about)


def read_hps_subject(path: str | Path) -> tuple[dict[str, float], dict[str, str]]:
    """A subject's shape of `hps_betas/SUBx.json`; its gender, and `root_to_heel_m`: the pelvis above the heels (0: not given).

    Raises WearcapError for missing betas or what is no number.
    """
    content = read_json_object(path)
    with understood("no betas that can be read", path, '{"betas": 10 numbers, "gender": …, "root_to_heel": …}'):
        betas = np.asarray(content["betas"], np.float64).reshape(-1)
        heel_m = float(content.get("root_to_heel", 0.0))
    if not (0 < len(betas) <= 300 and np.isfinite(betas).all() and np.isfinite(heel_m)):
        raise WearcapError(f"{len(betas)} betas, or some that are not finite", path, "10 numbers")
    about = {"gender": str(content.get("gender", "neutral")), "root_to_heel_m": f"{heel_m:.4f}"}
    return shape_from_betas(betas.tolist()), about


def read_hps_starts(path: str | Path) -> tuple[int, int]:
    """(frame of the localised video, frame of the suit) that show the same clap: `hps_inits/*.json`."""
    content = read_json_object(path)
    starts = [content.get(key) for key in ("cam_start", "imu_start")]
    if not all(isinstance(start, int | float) and 0 <= start <= MAX_FRAMES for start in starts):
        raise WearcapError(f"starts {starts}", path, '{"cam_start": frame, "imu_start": frame}, from 0')
    return int(starts[0]), int(starts[1])  # pyright: ignore[reportArgumentType]


def read_hps_localization(path: str | Path, fps: float | int = FPS) -> Localization:
    """Read `head_camera_localizations/*.json` {frame: {position, quaternion (w x y z)} or null}, frame 0 at 0 s.

    Frames that are null or absent have confidence 0, an identity rotation and position 0; the others confidence 1, for
    the file has no others. Raises WearcapError naming the frame for what is no pose, and when no frame has one.
    """
    rows = read_json_object(path)
    for key in rows:
        if not (key.isascii() and key.isdecimal() and len(key) < 20 and int(key) < MAX_FRAMES):
            raise WearcapError(f"frame {key[:30]!r}", path, "frame numbers from 0 as keys")
    frames = {key: int(key) for key in rows}
    if len(set(frames.values())) < len(frames):
        raise WearcapError("a frame is there twice", path)
    count = max(frames.values(), default=-1) + 1
    quat_wxyz, position = np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3))
    confidence = torch.zeros(count)
    for key, frame in frames.items():
        if rows[key] is not None:
            quat_wxyz[frame], position[frame] = read_pose(rows[key], f"{path}, frame {key}")
            confidence[frame] = 1.0
    if not confidence.any():
        raise WearcapError("no frame has a pose", path, "poses of some frames, null for the others")
    return Localization(
        torch.arange(count, dtype=torch.float64) / fps,
        rotation.matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz)).float(),
        torch.from_numpy(position).float(),
        confidence,
    )


def read_hps_cameras(path: str | Path) -> dict[str, Camera]:
    """Head cameras by video (name without suffix) of `head_camera_videos/cameras.json`: OpenCV's model, 1920x1080.

    Raises WearcapError naming the camera for missing or wrong parameters.
    """
    cameras: dict[str, Camera] = {}
    for serial, row in read_json_object(path).items():
        where = f"{path}, camera {serial!r}"
        expected = "parameters {focal_dist_xy, center_xy, dist_coeffs} and captured_videos"
        with understood("no intrinsics", where, expected), placed(where):
            focal, centre, distortion = (
                np.asarray(row["parameters"][key], np.float64).reshape(-1).tolist()
                for key in ("focal_dist_xy", "center_xy", "dist_coeffs")
            )
            videos = [Path(str(video)).stem for video in row["captured_videos"]]
            if not (len(focal) == len(centre) == 2 and np.isfinite([*focal, *centre, *distortion]).all()):
                raise ValueError(f"focal lengths {focal}, centre {centre}, distortion {distortion}")
            distortion = tuple((distortion + [0.0] * 4)[: max(4, len(distortion))])
            camera = Camera("opencv", *IMAGE_SIZE, *focal, *centre, distortion)
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
    found = (sure > 0)[:, None]
    return Localization(
        times,
        torch.where(found[..., None], rotation.between(R[before], R[after], blend), torch.eye(3)),
        torch.where(found, torch.lerp(t[before], t[after], blend[:, None]), torch.zeros(3)),
        sure,
    )


def nominal_mount() -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """(R_head_cam, t_head_cam) of an upright, forward-looking camera on the forehead (assumed: it is not measured)."""
    return CAMERA, torch.tensor([0.12, 0.0, 0.12])


_HIERARCHY = (
    "pelvis left_hip left_knee left_ankle left_foot right_hip right_knee right_ankle right_foot spine1 spine2 spine3 "
    "left_collar left_shoulder left_elbow left_wrist left_hand neck head "
    "right_collar right_shoulder right_elbow right_wrist right_hand"
)
UNITY_JOINTS = tuple(_HIERARCHY.split())
"""Order of the file's Euler angles: Unity's hierarchy of SMPL, depth first."""
_WITH_INNER_ROOT = 3 * (len(UNITY_JOINTS) + 1)
"""Files name the root twice: the avatar, which turns, and below it the model's own root, which does not."""


def read_unity_motion(pose_path: str | Path, trans_path: str | Path) -> Motion:
    """Read one sequence's `_pose.txt` and `_trans.txt` as a smpl24 motion at 30 Hz that begins at 0 s, z up.

    A last line that was cut short is left out. Raises WearcapError naming the line for a wrong count or what is no
    number, and for files whose lengths differ by more than one frame.
    """
    angles_deg = _table(pose_path, (_WITH_INNER_ROOT, 3 * len(UNITY_JOINTS)))
    if angles_deg.shape[1] == _WITH_INNER_ROOT:
        angles_deg = np.delete(angles_deg, [3, 4, 5], 1)
    trans = _table(trans_path, (3,))
    if abs(len(angles_deg) - len(trans)) > 1:
        what = f"{len(trans)} positions for {len(angles_deg)} poses"
        raise WearcapError(what, trans_path, f"as many lines as in {Path(pose_path).name}")
    count = min(len(angles_deg), len(trans))
    R_smpl = rotations_from_unity(torch.from_numpy(angles_deg[:count]).unflatten(1, (-1, 3)))
    skeleton = smpl24()
    order = [UNITY_JOINTS.index(name) for name in skeleton.joint_names]
    t_smpl = torch.from_numpy(trans[:count]) * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    t_smpl = t_smpl + torch.tensor(PELVIS_SMPL, dtype=torch.float64)
    return Motion(
        torch.arange(count, dtype=torch.float64) / FPS,
        skeleton,
        (A @ R_smpl[:, order] @ A.T).float(),
        (t_smpl @ A.T).float(),
        provenance={"source": Path(pose_path).name, "format": "hps unity"},
    )


def rotations_from_unity(angles_deg: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations in SMPL's axes from Unity's Euler angles (x, y, z in degrees)."""
    x, y, z = torch.deg2rad(angles_deg).unbind(-1)
    return about_axis("y", -y) @ about_axis("x", x) @ about_axis("z", -z)


def _table(path: str | Path, widths: tuple[int, ...]) -> np.ndarray:
    values, width = array("d"), 0
    short: WearcapError | None = None
    for number, line in numbered_lines(path):
        tokens = line.split()
        if not tokens:
            continue
        if short is not None:
            raise short
        width = width or len(tokens)
        if width not in widths or len(tokens) != width:
            short = WearcapError(
                f"{len(tokens)} numbers", where=at_line(path, number), expected=" or ".join(map(str, widths))
            )
            if len(tokens) >= width:
                raise short
            continue  # the recorder stops in the middle of a line: only the last may be short
        values.extend(finite_floats(tokens, at_line(path, number)))
    if not values:
        raise WearcapError("no lines of numbers", path)
    return np.asarray(values).reshape(-1, width)


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
        raise WearcapError(f"no sequence {name!r}", root, "a plain name, such as SUB4_MPI_Etage6_working_standing")
    motion_path = _one(root, f"*hps_smpl*/{name}.pkl")
    if motion_path is None:
        known = hps_names(root)
        expected = f"one of {len(known)}, such as {known[:3]}" if known else "hps_smpl/NAME.pkl"
        raise WearcapError(f"no sequence {name!r}", root, expected)
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
        raise WearcapError(f"no starts of sequence {name!r}", root, f"hps_inits/{name}.json", fix)
    cam_start, imu_start = (0, 0) if starts is None else read_hps_starts(starts)
    localization = None
    if localization_path is not None:
        localization = read_hps_localization(localization_path, camera_hz)
        if cam_start >= len(localization.timestamps):
            what = f"cam_start {cam_start} is beyond the {len(localization.timestamps)} localised frames"
            raise WearcapError(what, starts)
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
        raise WearcapError(f"imu_start {imu_start} is beyond the suit's {len(motion)} frames", name)
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
        raise WearcapError(f"no intrinsics for the video of {name!r}", calibration, expected)
    if path is None:
        return None if localization is None else CameraStream(localization.timestamps, cameras[name], *nominal_mount())
    video = video_info(path)
    if (video.width, video.height) != IMAGE_SIZE or not video.frames:
        what = f"a video of {video.frames} frames of {video.width}x{video.height} pixels"
        raise WearcapError(what, path, f"{IMAGE_SIZE[0]}x{IMAGE_SIZE[1]}, as its camera was calibrated")
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


def _examined(root: Path, name: str) -> tuple[Recording, list[Finding]]:
    recording = read_hps_sequence(root, name)
    return recording, check_files(recording, root)


KINDS = (Kind("HPS", _examined, knows=hps_names, parts=hps_names),)
"""How `wearcap doctor` knows the data set."""
VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


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


def hps_tasks(
    source: str | Path,  # the folder that holds hps_smpl and the others (scans unzipped in scans/)
    splits: Splits,
    fps: float | int = 30,  # motion, suit and localisation are brought to this rate
    camera_hz: float | int = 30,  # of the video that was localised; 29.97 where it was not resampled
    license: str = "HPS dataset licence; not to be passed on",
) -> list[Task]:
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
        key = content_hash(name, float(fps), float(camera_hz), license, VERSION, *small)
        tasks.append(Task(name, partial(_hps, source, name, fps, camera_hz, license), splits.of(subject), key))
    return tasks
