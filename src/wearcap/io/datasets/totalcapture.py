"""Real inertial sensors with ground-truth SMPL poses: TotalCapture (6 sensors) and DIP-IMU (17), in DIP's format.

Both worlds have y up and are turned by +90° about x. A sensor's orientation is that of its bone in SMPL's own axes (x
left, y up, z forward), so its mounting on wearcap's joint axes is `io.formats.smpl_axes.A`; accelerations are free of gravity.
"""

import io
import mmap
import pickletools
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from wearcap.body.skeletons import smpl24
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.bounded import Budget, file_size
from wearcap.io.formats.npz import read_npz, require
from wearcap.io.formats.restricted_pickle import read_pickle
from wearcap.io.formats.smpl_axes import A, rotations_from_smpl
from wearcap.recording import ImuStream, Motion

FPS = 60.0
TOTALCAPTURE = ("left_elbow", "right_elbow", "left_knee", "right_knee", "head", "pelvis")
"""Sensors of `ori` and `acc` as MocapEvery's authors read them, by the joint whose bone carries them: a forearm's is the
elbow. Other tools list the shins first; a file's order is checked against its pose."""
DIP_IMU = (
    "head",
    "spine3",
    "pelvis",
    "left_collar",
    "right_collar",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_wrist",
    "right_wrist",
    "left_ankle",
    "right_ankle",
)
R_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""Rotation of a world with y up to z up: +90° about x."""

_LAG_S = 0.25
"""Span (s) of the rotations that are compared: far beyond a sensor's noise, and mostly below half a turn."""
_WORSE = 1.5
"""An order is wrong when another one has an error smaller by this factor …"""
_WORSE_DEG = 2.0
"""… and by this many degrees, averaged over the sensors that it moves."""
_MAX_DEG = 30.0
"""Mean angle (°) between sensors and bones in the best order beyond which they are from different recordings."""
_GRAVITY = 5.0
"""Mean acceleration (m/s²) that only gravity explains."""
_NOT_ORTHONORMAL = 0.02
_MAX_STEPS, _MAX_WORD = 100_000, 1000
"""Most opcodes, and characters of a word, of the pickle in a PyTorch file; a dozen tensors take some hundred opcodes."""
_PICKLES_OF_OLD_FILES = 5
"""Pickles before the numbers of a non-archive file: magic number, version, system, content, storages."""


@dataclass(frozen=True)
class ImuSequence:
    """Sensors by joint, and the true motion (smpl24) where the file has it: the root stays at the origin."""

    imu: dict[str, ImuStream]
    motion: Motion | None


def read_totalcapture(
    path: str | Path, order: Sequence[str] = TOTALCAPTURE, motion: Motion | None = None
) -> ImuSequence:
    """Read `ori` (T, 6, 3, 3), `acc` (T, 6, 3) and, where it is there, `gt` (T, 72): a pickle, .npz or .pt, 60 Hz.

    The order of the sensors is checked against the file's pose, or against `motion` where the file has none; without
    either it is trusted. Raises WearcapError that names the order that fits when another one does, for anything but
    data in the file, for missing or misshapen arrays, matrices that are no rotations, and accelerations with gravity.
    """
    return _read(path, {"ori": "ori", "acc": "acc"}, order, motion)


def read_dip_imu(path: str | Path, order: Sequence[str] = DIP_IMU) -> ImuSequence:
    """Read `imu_ori` (T, 17, 3, 3), `imu_acc` (T, 17, 3), `gt` (T, 72) of DIP-IMU; samples that are NaN are left out.

    Raises WearcapError as `read_totalcapture` does.
    """
    return _read(path, {"ori": "imu_ori", "acc": "imu_acc"}, order, None)


def as_watches(imu: Mapping[str, ImuStream]) -> dict[str, ImuStream]:
    """The forearms' sensors as watches on the wrists, which turn with the forearm as long as the hand is not bent."""
    return {f"{side}_wrist": replace(imu[f"{side}_elbow"], joint=f"{side}_wrist") for side in ("left", "right")}


def _read(path: str | Path, keys: dict[str, str], order: Sequence[str], motion: Motion | None) -> ImuSequence:
    path = Path(path)
    skeleton = smpl24()
    if len(set(order)) < len(order) or not set(order) <= set(skeleton.joint_names):
        raise WearcapError(f"an order of sensors {list(order)}", where=path, expected="different joints of smpl24")
    arrays = _arrays(path, (*keys.values(), "gt"))
    ori, acc = (_wanted(arrays, keys[part], path) for part in ("ori", "acc"))
    frames = len(ori)
    if ori.shape != (frames, len(order), 3, 3) or acc.shape != (frames, len(order), 3) or not frames:
        raise WearcapError(
            f"{keys['ori']} and {keys['acc']} of shapes {ori.shape} and {acc.shape}",
            where=path,
            expected=f"(T, {len(order)}, 3, 3) and (T, {len(order)}, 3)",
        )
    if "gt" in arrays:
        motion = _motion(arrays, frames, path)
    R = R_UP @ torch.from_numpy(ori.astype(np.float64))
    acc_world = torch.from_numpy(acc.astype(np.float64)) @ R_UP.T
    streams = {
        joint: _stream(joint, R[:, k], acc_world[:, k], f"{path}, sensor {k} ({joint})")
        for k, joint in enumerate(order)
    }
    if motion is not None:
        require_order(streams, motion, path)
    return ImuSequence(streams, motion)


def require_order(imu: Mapping[str, ImuStream], motion: Motion, where: str | Path) -> None:
    """Raise WearcapError when the sensors rotate like other joints than those they are assigned to.

    Rotations over a quarter of a second in the world are compared, which do not depend on the mounting. Joints that turn
    alike may be confused without harm: an order is wrong only when another one fits far better.
    """
    joints = list(imu)
    cost = _turn_differences(imu, motion)
    row, best = linear_sum_assignment(cost)
    moved = best != row
    assigned, fits = np.rad2deg(np.diag(cost)), np.rad2deg(cost[row, best])
    if fits.mean() > _MAX_DEG:
        raise WearcapError(
            f"the sensors turn {fits.mean():.0f}° apart from the body, in whatever order",
            where=where,
            expected="sensors and pose of the same recording",
        )
    if moved.any():
        now, other = assigned[moved].mean(), fits[moved].mean()
        if now > _WORSE * other and now > other + _WORSE_DEG:
            order = ", ".join(joints[k] for k in best)
            raise WearcapError(
                f"the sensors are in another order: {now:.1f}° apart from their joints, {other:.1f}° in the order "
                f"that fits",
                where=where,
                expected=", ".join(joints),
                fix=f"Give order=({order}).",
            )


def _turn_differences(imu: Mapping[str, ImuStream], motion: Motion) -> Float[np.ndarray, "sensor sensor"]:
    """Mean angle (rad) between each sensor's rotations (rows) and each joint's (columns), over frames that both have."""
    lag = max(round(_LAG_S * motion.fps), 1) if len(motion) > 1 else 1
    if len(motion) <= lag:
        return np.zeros((len(imu), len(imu)))
    index = motion.skeleton.indices(*imu)
    R_world_joint = motion.T_world_joint.R[:, index].double()
    turn_joint = R_world_joint[lag:] @ R_world_joint[:-lag].mT
    cost = np.zeros((len(imu), len(imu)))
    for k, stream in enumerate(imu.values()):
        frame = torch.searchsorted(motion.timestamps, stream.timestamps - 1e-6).clamp(max=len(motion) - 1)
        R = torch.full((len(motion), 3, 3), torch.nan, dtype=torch.float64)
        if stream.R_world_imu is not None:
            R[frame] = stream.R_world_imu.double()
        turn = R[lag:] @ R[:-lag].mT
        there = turn.isfinite().all(-1).all(-1)
        if there.any():
            cost[k] = (
                rotation.geodesic(turn[there, None].expand_as(turn_joint[there]), turn_joint[there]).mean(0).numpy()
            )
    return cost


def _motion(arrays: dict[str, np.ndarray], frames: int, path: Path) -> Motion:
    pose = arrays["gt"].reshape(len(arrays["gt"]), -1)
    require({"gt": pose}, path, gt=("time", 72))
    if len(pose) != frames:
        raise WearcapError(f"{len(pose)} poses for {frames} samples", where=path, expected="one each")
    R = rotations_from_smpl(torch.from_numpy(pose.astype(np.float64)).unflatten(1, (-1, 3)))
    R = torch.cat([R_UP @ R[:, :1], R[:, 1:]], 1)
    return Motion(
        torch.arange(frames, dtype=torch.float64) / FPS,
        smpl24(),
        R.float(),
        torch.zeros(frames, 3),
        provenance={"source": path.name, "format": "totalcapture"},
    )


def _stream(joint: str, R: Float[Tensor, "time 3 3"], acc: Float[Tensor, "time 3"], where: str) -> ImuStream:
    """One sensor's stream without NaN samples."""
    there = R.isfinite().all(-1).all(-1) & acc.isfinite().all(-1)
    if there.sum() < max(len(R) // 2, 1):
        raise WearcapError(
            f"{int((~there).sum())} of {len(R)} samples are not finite", where=where, expected="half of them at least"
        )
    R, acc = R[there], acc[there]
    away = (R.mT @ R - torch.eye(3, dtype=R.dtype)).abs().amax((-1, -2))
    bad = (away > _NOT_ORTHONORMAL) | (torch.linalg.det(R) < 0)
    if bad.any():
        raise WearcapError(
            f"{int(bad.sum())} orientations are no rotations", where=where, expected="orthonormal matrices"
        )
    mean = acc.mean(0).norm().item()
    if mean > _GRAVITY:
        raise WearcapError(
            f"a mean acceleration of {mean:.1f} m/s²",
            where=where,
            expected="free acceleration",
            fix="Take gravity out of it.",
        )
    times = torch.arange(len(there), dtype=torch.float64)[there] / FPS
    return ImuStream(times, joint, R.float(), acc.float(), R_joint_imu=A.float())


def _arrays(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The named arrays of a pickle, .npz or PyTorch file."""
    if path.suffix == ".npz":
        content = read_npz(path, names)
    else:
        content = _torch_content(path) if path.suffix in (".pt", ".pth") else read_pickle(path)
    if not isinstance(content, dict):
        raise WearcapError(f"it holds a {type(content).__name__}", where=path, expected=f"a dict of {', '.join(names)}")
    found = {name: content[name] for name in names if name in content}
    for name, value in found.items():
        value = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            raise WearcapError(
                f"{name} is a {type(value).__name__}",
                where=path,
                expected="an array of numbers",
                fix="Several sequences in one file: save one of them.",
            )
        found[name] = value
    return found


def _torch_content(path: Path) -> Any:
    budget = Budget(path, file_size(path))
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                budget.spend(sum(info.file_size for info in archive.infolist()))
        _require_short_words(path)
        return torch.load(path, map_location="cpu", weights_only=True)
    except WearcapError:
        raise
    except Exception as error:  # the opcodes are the file's own program and can raise anything
        raise WearcapError(
            f"not a readable PyTorch file ({' '.join(str(error).split())[:120]})",
            where=path,
            expected="a dict of tensors, without code",
        ) from error


def _require_short_words(path: Path) -> None:
    """Raise for long words and programs: torch searches its messages, which repeat them, in quadratic time."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                if name.rpartition("/")[2] == "data.pkl":
                    _walk(io.BytesIO(archive.read(name)))
    else:
        # Mapped: a length in it reserves no more memory than the file has bytes.
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
            for _ in range(_PICKLES_OF_OLD_FILES):
                _walk(mapped)


def _walk(stream: io.BytesIO | mmap.mmap) -> None:
    """Go through one pickle without running it."""
    for step, (_, argument, _) in enumerate(pickletools.genops(stream)):
        if step > _MAX_STEPS or (isinstance(argument, str | bytes) and len(argument) > _MAX_WORD):
            raise ValueError(f"more than {_MAX_STEPS} steps, or a word longer than {_MAX_WORD} characters")


def _wanted(arrays: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    if name not in arrays:
        raise WearcapError(f"no array {name!r}", where=path, expected="the sensors' orientations and accelerations")
    return arrays[name]
