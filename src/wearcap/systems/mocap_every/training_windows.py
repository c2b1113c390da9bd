"""Training windows of MocapEvery's estimator: head and wrist inputs with the ground-truth motion."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset

from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.datamodule import SeededWindows
from wearcap.data.features import body_size
from wearcap.data.windows import Source, joint_twins, mirrored_rotations, requested, share_out, true_foot_contact
from wearcap.geometry import rotation
from wearcap.recording.store import RecordingFile
from wearcap.systems.mocap_every.features import Sensed, mirrored, synthetic_wrists


class WatchWindow(NamedTuple):
    """One window, or a batch of them (a leading "batch" axis on every field)."""

    R_world_head: Float[Tensor, "*batch time 3 3"]
    t_world_head: Float[Tensor, "*batch time 3"]
    R_world_wrist: Float[Tensor, "*batch time wrist 3 3"]
    acc_world_wrist: Float[Tensor, "*batch time wrist 3"]
    t_world_wrist: Float[Tensor, "*batch time wrist 3"]
    floor_height: Float[Tensor, "*batch time"]
    size: Float[Tensor, "*batch limb"]
    """`body_size` of the wearer (m)."""
    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    t_world_root: Float[Tensor, "*batch time 3"]
    t_parent_joint: Float[Tensor, "*batch joint 3"]
    foot_contact: Float[Tensor, "*batch time foot"]
    """1 where heel or toes of the left and right foot touch the floor."""

    @property
    def sensed(self) -> Sensed:
        return Sensed(*self[:5])


@dataclass(frozen=True)
class Variation:
    """Data augmentation by time and size, and simulated sensor errors: errors that are constant within a window (of
    1.3 s), and white noise of the acceleration. The defaults change nothing."""

    stretch: float = 1.0
    """Largest factor by which a motion is sped up or slowed down; accelerations scale with its square."""
    scale: float = 1.0
    """Largest factor by which wearer and world are enlarged or shrunk."""
    wrist_deg: float = 0.0
    """Standard deviation of a wrist's orientation error about each axis: strap, attitude, heading."""
    acc_m_s2: float = 0.0
    """Standard deviation of the acceleration's white noise (m/s²)."""
    head_deg: float = 0.0
    """Standard deviation of the head's orientation error about each axis."""
    floor_m: float = 0.0
    """Standard deviation of the floor height's error."""


class WatchDataset(Dataset):
    """Windows of one split of one or more data sets, indexed by (window, seed) or by the window only.

    Sensor inputs are computed on the first access to a recording and cached: 0.8 GB for four hours at 60 Hz.
    """

    def __init__(
        self,
        sources: list[Source],
        split: str,
        *,
        window: int,
        stride: int,
        fps: float,
        every: int,
        augment: bool = False,
        balance: float = 1.0,
        variation: Variation | None = None,
        beginnings: float = 0.0,
    ):
        """Of recordings at `fps` frames per second every `every`-th frame is used; `window` and `stride` count those.

        `augment` shifts windows by up to a stride, mirrors half of them, turns them about the vertical, and applies
        `variation`. `balance`: see `WindowDataset`. `beginnings` is the share of windows whose first frames repeat one
        frame, as at the beginning of a capture.
        """
        self.window, self.stride, self.fps, self.every = window, stride, fps / every, every
        self.augment, self.variation, self.beginnings = augment, variation or Variation(), beginnings
        self.recordings, self.starts, self.weights = share_out(
            sources,
            split,
            window=window * every,
            stride=stride * every,
            fps=fps,
            balance=balance,
            min_frames=window * every,
        )

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, item: tuple[int, int] | int) -> WatchWindow:
        index, random = requested(item)
        shift, mirror, turn, begins, padding, faster, larger = torch.rand(7, generator=random).tolist()
        recording, start, _ = self.starts[index].tolist()
        store, name = self.recordings[recording]
        whole = watched(store.path_of(name), self.every)
        speed = self.variation.stretch ** (2 * faster - 1) if self.augment else 1.0
        span = (self.window - 1) * self.every * speed
        first = start + (shift * self.stride * self.every if self.augment else 0)
        first = min(first, max(len(whole.floor_height) - 1 - span, 0.0))
        frames = first + self.every * speed * torch.arange(self.window)
        if begins < self.beginnings:
            frames = frames.clamp_min(frames[int(padding * (self.window - 2))].item())
        window = whole.window(frames.clamp_max(len(whole.floor_height) - 1), speed)
        if not self.augment:
            return window
        window = scaled(window, self.variation.scale ** (2 * larger - 1))
        window = self._with_sensor_errors(turned(window, 2 * torch.pi * turn), random)
        return mirrored_window(window, whole.skeleton) if mirror < 0.5 else window

    def _with_sensor_errors(self, window: WatchWindow, random: torch.Generator) -> WatchWindow:
        """A window with random errors of watches, head tracking and floor height."""
        errors = self.variation
        angle = torch.randn(3, 3, generator=random).deg2rad()
        turn = rotation.exp(angle * torch.tensor([[errors.wrist_deg], [errors.wrist_deg], [errors.head_deg]]))
        return window._replace(
            R_world_wrist=window.R_world_wrist @ turn[:2],
            acc_world_wrist=(turn[:2] @ window.acc_world_wrist[..., None])[..., 0]
            + errors.acc_m_s2 * torch.randn(window.acc_world_wrist.shape, generator=random),
            R_world_head=window.R_world_head @ turn[2],
            floor_height=window.floor_height + errors.floor_m * torch.randn(1, generator=random),
        )


@dataclass(frozen=True)
class Watched:
    """Inputs and ground truth of a whole recording, at its own frame rate."""

    sensed: Sensed
    floor_height: Float[Tensor, "time"]
    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_world_root: Float[Tensor, "time 3"]
    foot_contact: Float[Tensor, "time foot"]
    skeleton: Skeleton
    size: Float[Tensor, "limb"]

    def window(self, frames: Float[Tensor, "frame"], speed: float = 1.0) -> WatchWindow:
        """Window at fractional frame numbers, interpolated; accelerations are scaled to the playback speed."""
        low = frames.long()
        share, high = frames - low, (low + 1).clamp_max(len(self.floor_height) - 1)

        def between(part: Tensor) -> Tensor:
            blend = share.reshape(-1, *[1] * (part.ndim - 1))
            return torch.lerp(part[low], part[high], blend)

        def turned_between(part: Tensor) -> Tensor:
            return rotation.matrix_from_rot6d(rotation.rot6d_from_matrix(between(part)))

        sensed = self.sensed
        return WatchWindow(
            turned_between(sensed.R_world_head),
            between(sensed.t_world_head),
            turned_between(sensed.R_world_wrist),
            speed**2 * between(sensed.acc_world_wrist),
            between(sensed.t_world_wrist),
            between(self.floor_height),
            self.size,
            turned_between(self.R_parent_joint),
            between(self.t_world_root),
            self.skeleton.t_parent_joint,
            self.foot_contact[frames.round().long()],
        )


@cache
def watched(path: Path, every: int) -> Watched:
    """Load a recording's head stream and synthesise watches on its true motion (the paper's protocol, eq. 8)."""
    file = RecordingFile(path)
    recording = file.load()
    motion, head = recording.motion, recording.head
    assert motion is not None
    assert head is not None
    wrists = synthetic_wrists(motion.skeleton, motion.R_parent_joint, motion.t_world_root, motion.fps, every)
    floor = recording.floor.height if recording.floor is not None else torch.zeros(len(motion))
    return Watched(
        Sensed(head.T_world_head.R, head.T_world_head.t, *wrists),
        floor.float(),
        motion.R_parent_joint,
        motion.t_world_root,
        true_foot_contact(recording).float(),
        motion.skeleton,
        body_size(motion.skeleton),
    )


def turned(window: WatchWindow, angle: float) -> WatchWindow:
    """The window turned about the world's vertical by an angle (rad)."""
    R = rotation.about_axis("z", torch.tensor(angle))
    root = torch.cat([(R @ window.R_parent_joint[:, 0])[:, None], window.R_parent_joint[:, 1:]], 1)
    return window._replace(
        R_world_head=R @ window.R_world_head,
        t_world_head=window.t_world_head @ R.mT,
        R_world_wrist=R @ window.R_world_wrist,
        acc_world_wrist=window.acc_world_wrist @ R.mT,
        t_world_wrist=window.t_world_wrist @ R.mT,
        R_parent_joint=root,
        t_world_root=window.t_world_root @ R.mT,
    )


def scaled(window: WatchWindow, factor: float) -> WatchWindow:
    """The window with wearer and world scaled by a factor."""
    return window._replace(
        t_world_head=window.t_world_head * factor,
        acc_world_wrist=window.acc_world_wrist * factor,
        t_world_wrist=window.t_world_wrist * factor,
        floor_height=window.floor_height * factor,
        size=window.size * factor,
        t_world_root=window.t_world_root * factor,
        t_parent_joint=window.t_parent_joint * factor,
    )


def mirrored_window(window: WatchWindow, skeleton: Skeleton) -> WatchWindow:
    """The window mirrored, left and right swapped."""
    flip = torch.tensor(MIRROR)
    twins = joint_twins(skeleton)
    return window._replace(
        **mirrored(window.sensed)._asdict(),
        R_parent_joint=mirrored_rotations(window.R_parent_joint, skeleton),
        t_world_root=window.t_world_root * flip,
        t_parent_joint=window.t_parent_joint[twins] * flip,
        foot_contact=window.foot_contact.flip(1),
    )


class WatchWindows(SeededWindows):
    """Lightning data module of `WatchDataset`."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        window: int,
        stride: int,
        fps: float,
        every: int,
        batch_size: int,
        steps_per_epoch: int | None = None,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        augment: bool = True,
        balance: float = 1.0,
        variation: Variation | None = None,
        beginnings: float = 0.0,
        val_sources: dict[str, dict | None] | None = None,
    ):
        """See `SeededWindows` and `WatchDataset`; augmentation applies to training only."""
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.window, self.stride, self.fps, self.every = window, stride, fps, every
        self.augment, self.balance, self.variation, self.beginnings = augment, balance, variation, beginnings

    def dataset(self, split: str) -> WatchDataset:
        train = split == "train"
        return WatchDataset(
            self.sources if train else self.val_sources,
            split,
            window=self.window,
            stride=self.stride,
            fps=self.fps,
            every=self.every,
            augment=self.augment and train,
            balance=self.balance if train else 1.0,
            variation=self.variation,
            beginnings=self.beginnings if train else 0.0,
        )
