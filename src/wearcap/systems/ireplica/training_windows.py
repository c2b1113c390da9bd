"""Training windows of poses with true hand contact; content and order are functions of seed and step."""

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.utils.data import Dataset

from wearcap.body.skeleton import Skeleton
from wearcap.body.skeletons import skeleton_by_name
from wearcap.data.datamodule import SeededWindows
from wearcap.data.windows import Source, mirrored_rotations, requested, share_out
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.recording.interactions import Interactions
from wearcap.recording.store import RecordingFile
from wearcap.systems.ireplica.features import PoseFeatures, is_even, pose_frames


class ContactWindow(NamedTuple):
    """One window, or a batch of them (a leading "batch" axis on every field)."""

    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    error: Float[Tensor, "*batch time joint 3"]
    """Pose noise as rotation vectors (rad), drawn with the window so that it depends on seed and step only."""
    contact: Bool[Tensor, "*batch time hand class"]


@dataclass(frozen=True)
class Augmentation:
    """Augmentation of training windows. Zeros (and a stretch of 1) disable it."""

    mirror: bool = True
    """Whether half of the windows are mirrored."""
    noise_deg: float = 5.0
    """Largest noise of joint rotations (°): a random mixture of constant, slow and per-frame noise."""
    stretch: float = 1.2
    """Largest factor by which time is stretched or compressed; poses are then interpolated between frames."""
    drop: float = 0.2
    """Largest share of frames that are dropped and interpolated."""


NONE = Augmentation(mirror=False, noise_deg=0.0, stretch=1.0, drop=0.0)


class ContactDataset(Dataset):
    """Windows of one split, in the skeleton of a network's input. An item is indexed by (window, seed), or by window.

    `stream` is "suit" (sensed poses) or "motion" (ground truth). Recordings with the same skeleton and frame rate are
    read from the memory map; others are converted on first use and kept in memory.
    """

    def __init__(
        self,
        sources: list[Source],
        split: str,
        *,
        window: int,
        stride: int,
        fps: float,
        classes: tuple[str, ...],
        skeleton: Skeleton,
        stream: str = "suit",
        augmentation: Augmentation = NONE,
        balance: float = 1.0,
    ):
        if stream not in ("suit", "motion"):
            raise WearcapError(f"no stream of poses {stream!r}", expected='"suit" or "motion"')
        self.window, self.stride, self.fps, self.classes = window, stride, fps, classes
        self.skeleton, self.stream, self.augmentation = skeleton, stream, augmentation
        self.longest = math.ceil(window * augmentation.stretch) + 1
        self.recordings, self.starts, self.weights = share_out(
            sources, split, window=window, stride=stride, fps=fps, balance=balance, min_frames=self.longest
        )

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, item: tuple[int, int] | int) -> ContactWindow:
        index, random = requested(item)
        recording, start, _ = self.starts[index].tolist()
        store, name = self.recordings[recording]
        poses = _poses(store.path_of(name), self.stream, self.skeleton.name, self.fps)
        shift, mirrored, speed = torch.rand(3, generator=random).tolist()
        if self.augmentation != NONE:
            start += int(shift * self.stride)
        start = min(start, poses.length - self.longest)
        place = torch.arange(self.window) * self.augmentation.stretch ** (2 * speed - 1)
        R = poses.rotations(start, start + self.longest)
        if self.augmentation != NONE:
            R = interpolated(R, self._kept(random), place)
        contact = poses.contact(start + place, self.classes)
        error = pose_errors(self.window, len(self.skeleton), self.augmentation.noise_deg, random)
        if self.augmentation.mirror and mirrored < 0.5:
            R, contact = mirrored_rotations(R, self.skeleton), contact.flip(1)
        return ContactWindow(R[: self.window], error, contact)

    def _kept(self, random: torch.Generator) -> Bool[Tensor, "time"]:
        share = self.augmentation.drop * torch.rand(1, generator=random)
        kept = torch.rand(self.longest, generator=random) >= share
        kept[[0, -1]] = True
        return kept


def interpolated(
    R: Float[Tensor, "time joint 3 3"], kept: Bool[Tensor, "time"], place: Float[Tensor, "new_time"]
) -> Float[Tensor, "new_time joint 3 3"]:
    """Rotations at fractional frames `place`, interpolated linearly (and orthogonalised) between the kept frames."""
    frames = kept.nonzero()[:, 0]
    after = torch.searchsorted(frames, place, right=True).clamp(1, len(frames) - 1)
    before = frames[after - 1]
    blend = ((place - before) / (frames[after] - before))[:, None, None, None].to(R.dtype)
    columns = torch.lerp(R[before, :, :, :2], R[frames[after], :, :, :2], blend)
    return rotation.matrix_from_rot6d(columns.transpose(-1, -2).flatten(-2))


def pose_errors(
    frames: int, joints: int, greatest_deg: float, random: torch.Generator
) -> Float[Tensor, "time joint 3"]:
    """Pose noise as rotation vectors (rad): a random mixture of constant, slow (1 s) and per-frame noise of random
    size."""
    size, *shares = torch.rand(4, generator=random).tolist()
    scale = math.radians(greatest_deg * size) / math.sqrt(3 * sum(share**2 for share in shares))
    knots = torch.randn(2 + frames // 60, 3 * joints, generator=random)
    place = torch.linspace(0, len(knots) - 1, frames)
    below = place.long().clamp(max=len(knots) - 2)
    slow = torch.lerp(knots[below], knots[below + 1], (place - below)[:, None])
    fixed = torch.randn(1, 3 * joints, generator=random)
    quick = torch.randn(frames, 3 * joints, generator=random)
    error = scale * (shares[0] * fixed + shares[1] * slow + shares[2] * quick)
    return error.unflatten(-1, (joints, 3))


@dataclass(frozen=True, eq=False)
class _Poses:
    """An open recording: poses at the data set's rate, and interactions."""

    file: RecordingFile
    stream: str
    timestamps: Float64[Tensor, "time"]
    interactions: Interactions
    converted: Float[Tensor, "time joint 3 3"] | None

    @property
    def length(self) -> int:
        return len(self.timestamps)

    def rotations(self, start: int, stop: int) -> Float[Tensor, "time joint 3 3"]:
        if self.converted is not None:
            return self.converted[start:stop]
        return self.file.window(f"{self.stream}.R_parent_joint", start, stop)

    def contact(self, place: Float[Tensor, "place"], classes: tuple[str, ...]) -> Bool[Tensor, "place hand class"]:
        """True contact at fractional frames `place`."""
        below = place.long().clamp(max=self.length - 2)
        times = torch.lerp(self.timestamps[below], self.timestamps[below + 1], place.double() - below)
        return torch.stack([self.interactions.hand_contact(times, name) for name in classes], -1)


@cache
def _poses(path: Path, stream: str, skeleton_name: str, fps: float) -> _Poses:
    """Open a recording, once per process."""
    file, skeleton = RecordingFile(path), skeleton_by_name(skeleton_name)
    interactions = file.part("interactions")
    if f"{stream}.timestamps" not in file.keys or interactions is None:
        missing = "interactions" if interactions is None else stream
        raise WearcapError(
            f"this recording has no {missing}, which contact detection learns from",
            where=path,
            fix="Prepare a data set with interactions, such as `wearcap prepare simulated_interactions`.",
        )
    timestamps = file.tensor(f"{stream}.timestamps")
    motion: Motion = file.part(stream)
    if is_even(timestamps, fps) and motion.skeleton.joint_names == skeleton.joint_names:
        return _Poses(file, stream, timestamps, interactions, None)
    timestamps, converted = pose_frames(motion, skeleton, fps)
    return _Poses(file, stream, timestamps, interactions, converted.contiguous())


class ContactWindows(SeededWindows):
    """Data module of windows of poses with true hand contact."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        features: PoseFeatures,
        classes: list[str],
        window: int,
        stride: int,
        fps: float,
        batch_size: int,
        steps_per_epoch: int | None = None,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        stream: str = "suit",
        augmentation: Augmentation = NONE,
        balance: float = 1.0,
        val_sources: dict[str, dict | None] | None = None,
    ):
        """See `SeededWindows` and `ContactDataset`; `augmentation` and `balance` apply to training only."""
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.features, self.classes = features, tuple(classes)
        self.window, self.stride, self.fps, self.stream = window, stride, fps, stream
        self.augmentation, self.balance = augmentation, balance

    def dataset(self, split: str) -> ContactDataset:
        train = split == "train"
        return ContactDataset(
            self.sources if train else self.val_sources,
            split,
            window=self.window,
            stride=self.stride,
            fps=self.fps,
            classes=self.classes,
            skeleton=self.features.skeleton,
            stream=self.stream,
            augmentation=self.augmentation if train else NONE,
            balance=self.balance if train else 1.0,
        )
