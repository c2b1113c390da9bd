"""Windows of recordings, read from memory-mapped files; content and order are functions of seed and step."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from wearcap.body.skeleton import FEET, FOOT_PATCHES, MIRROR, Skeleton
from wearcap.data.features import body_size
from wearcap.data.surroundings import NOTHING, Surroundings
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.metrics import physics
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.tracking.floor import floor_from_path, floor_from_points

MIN_FRAMES = 10
"""Fewest frames of an incomplete first window in training (`beginnings`)."""


class Window(NamedTuple):
    """One window, or a batch of them (a leading "batch" axis on every field); frames beyond a clip are padding."""

    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    R_world_head: Float[Tensor, "*batch time 3 3"]
    t_world_head: Float[Tensor, "*batch time 3"]
    floor_height: Float[Tensor, "*batch time"]
    """Floor height (m) below the head, from points if there are any, else from the head's path."""
    floor_from_head: Float[Tensor, "*batch time"]
    """Floor height (m) below the head, from the head's path alone."""
    valid: Bool[Tensor, "*batch time"]
    t_parent_joint: Float[Tensor, "*batch joint 3"]
    size: Float[Tensor, "*batch limb"]
    """`body_size` of the wearer (m)."""
    foot_contact: Float[Tensor, "*batch time foot"]
    """1 where heel or toes of the left and right foot touch the floor."""
    points: Float[Tensor, "*batch time point_feature"]
    points_valid: Bool[Tensor, "*batch time"]
    image: Float[Tensor, "*batch time image_feature"]
    image_valid: Bool[Tensor, "*batch time"]
    """Points and images: see `Surroundings`; no columns for a modality that is left out."""
    noise: Float[Tensor, "*batch time motion"]
    level: Float[Tensor, "*batch 1"]
    chance: Float[Tensor, "*batch 3"]
    """Diffusion noise and level, and uniform random numbers that decide on dropped modalities and self-conditioning;
    drawn here so that they depend on seed and step, not on the process."""

    @property
    def stature(self) -> Float[Tensor, "*batch"]:
        """Height of the head joint in the rest pose (m)."""
        return self.size[..., 0]


@dataclass(frozen=True)
class Source:
    """One data set to sample windows from, with its sampling weight."""

    root: str
    weight: float = 1.0


def share_out(
    sources: list[Source],
    split: str,
    *,
    window: int,
    stride: int,
    fps: float,
    balance: float = 1.0,
    min_frames: int = 30,
) -> tuple[list[tuple[RecordingStore, str]], Int64[Tensor, "window 3"], Float64[Tensor, "window"]]:
    """Recordings of a split (data set and name), its windows as (recording, first frame, frames of the recording), and
    the windows' sampling weights.

    Recordings shorter than `min_frames` are left out. Raises WearcapError for a recording at another rate than `fps`,
    and when there are no windows.
    """
    recordings: list[tuple[RecordingStore, str]] = []
    starts, weights = [], []
    for source in sources:
        store = RecordingStore.open(source.root)
        rows = [(name, store.entries[name].frames) for name in _usable(store, split, fps, min_frames)]
        counts = [max(0, frames - window) // stride + 1 for _, frames in rows]
        total = sum(count**balance for count in counts)
        for (name, frames), count in zip(rows, counts):
            starts += [(len(recordings), k * stride, frames) for k in range(count)]
            weights += [source.weight * count ** (balance - 1) / total] * count
            recordings.append((store, name))
    if not starts:
        raise WearcapError(
            f"no windows in split {split!r}",
            where=", ".join(s.root for s in sources),
            expected=f"recordings of at least {min_frames} frames",
        )
    return recordings, torch.tensor(starts), torch.tensor(weights, dtype=torch.float64)


def _usable(store: RecordingStore, split: str, fps: float, min_frames: int) -> Iterator[str]:
    for name in store.names(split):
        entry = store.entries[name]
        if abs(entry.fps - fps) > 0.01 * fps:
            raise WearcapError(
                f"recording {name!r} has {entry.fps} frames per second",
                where=store.root,
                expected=f"{fps}",
                fix="Prepare the data set at that rate.",
            )
        if entry.frames >= min_frames:
            yield name


def requested(item: tuple[int, int] | int) -> tuple[int, torch.Generator]:
    """Window index of a data set's item, and the random generator of its augmentation.

    An index without a seed comes from Lightning's overfit_batches, which replaces the sampler: the index is the seed.
    """
    index, seed = item if isinstance(item, tuple) else (item, item)
    return index, torch.Generator().manual_seed(seed)


class WindowDataset(Dataset):
    """Windows of one split of one or more data sets, indexed by (window, seed) or by window alone."""

    def __init__(
        self,
        sources: list[Source],
        split: str,
        *,
        window: int,
        stride: int,
        fps: float,
        mirror: bool = False,
        balance: float = 1.0,
        min_frames: int = 30,
        surroundings: Surroundings = NOTHING,
        beginnings: float = 0.0,
    ):
        """A recording's sampling weight is its number of windows to the power of `balance`.

        1 samples all windows equally, 0 all recordings. `beginnings` is the share of incomplete windows, as the first
        ones of a capture are.
        """
        self.window, self.stride, self.fps, self.mirror = window, stride, fps, mirror
        self.surroundings, self.beginnings = surroundings, beginnings
        self.recordings, self.starts, self.weights = share_out(
            sources, split, window=window, stride=stride, fps=fps, balance=balance, min_frames=min_frames
        )
        self.image_size = surroundings.image_size([RecordingStore.open(source.root) for source in sources])

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, item: tuple[int, int] | int) -> Window:
        index, random = requested(item)
        recording, start, frames = self.starts[index].tolist()
        shift, mirrored, cut, end = torch.rand(4, generator=random).tolist()
        if self.mirror:
            start = min(start + int(shift * self.stride), max(frames - self.window, 0))
        length = self.window if cut >= self.beginnings else MIN_FRAMES + int(end * (self.window - MIN_FRAMES))
        return self._read(*self.recordings[recording], start, length, self.mirror and mirrored < 0.5, random)

    def _read(
        self, store: RecordingStore, name: str, start: int, length: int, mirrored: bool, random: torch.Generator
    ) -> Window:
        """Frames start…start+length-1 of a recording, padded to a whole window by the last frame."""
        file = _open(store.path_of(name))
        constants = _constants(file.path)
        stop = min(start + length, file.length("motion.timestamps"))
        take = torch.arange(self.window).clamp_max(stop - start - 1)
        T_world_device = Rigid(
            file.window("head.R_world_device", start, stop), file.window("head.t_world_device", start, stop)
        )
        T_world_head = (T_world_device @ constants.T_device_head)[take]
        seen = self.surroundings.read(store, name, start, stop, mirrored, self.image_size)
        joints = len(constants.skeleton)
        window = Window(
            file.window("motion.R_parent_joint", start, stop)[take],
            T_world_head.R,
            T_world_head.t,
            constants.floor_height[start:stop][take],
            constants.floor_from_head[start:stop][take],
            torch.arange(self.window) < stop - start,
            constants.skeleton.t_parent_joint,
            constants.size,
            constants.foot_contact[start:stop][take],
            *(part[take] for part in seen),
            torch.randn(self.window, 6 * joints + FEET, generator=random),
            torch.rand(1, generator=random),
            torch.rand(3, generator=random),
        )
        return mirror_window(window, constants.skeleton) if mirrored else window


@cache
def _open(path: Path) -> RecordingFile:
    """Files stay open per process, so that a window reads its own bytes only."""
    return RecordingFile(path)


@dataclass(frozen=True)
class _Constants:
    """Values that all windows of a recording share, and per-frame values that are cheap to keep in memory."""

    skeleton: Skeleton
    T_device_head: Rigid
    size: Float[Tensor, "limb"]
    floor_height: Float[Tensor, "time"]
    floor_from_head: Float[Tensor, "time"]
    foot_contact: Float[Tensor, "time foot"]


@cache
def _constants(path: Path) -> _Constants:
    file = _open(path)
    if file.length("head.timestamps") != file.length("motion.timestamps"):
        raise WearcapError(
            "head and motion have different lengths",
            where=path,
            expected="both on one clock",
            fix="Prepare the recording again.",
        )
    recording = file.load()
    head, motion = recording.head, recording.motion
    assert head is not None
    assert motion is not None
    stature, t_world_head = motion.skeleton.height_of("head"), head.T_world_head.t
    from_path = floor_from_path(head.timestamps, t_world_head, stature)
    from_points = floor_from_points(recording.points, t_world_head, stature)
    mount = Rigid(head.R_head_device, head.t_head_device)
    return _Constants(
        motion.skeleton,
        mount.inverse(),
        body_size(motion.skeleton),
        from_path if from_points is None else from_points,
        from_path,
        true_foot_contact(recording).float(),
    )


def true_foot_contact(recording: Recording) -> Bool[Tensor, "time foot"]:
    """Contact of the left and right foot at the motion's frames, as recorded or else estimated from the true motion."""
    motion, track = recording.motion, recording.contacts
    assert motion is not None
    if track is not None and set(FOOT_PATCHES) <= set(track.parts) and len(track.contact) == len(motion):
        return physics.foot_contact(track.contact[:, [track.parts.index(patch) for patch in FOOT_PATCHES]])
    pose = motion.T_world_joint
    points = physics.foot_points(motion.skeleton, pose)
    return physics.contact_from_motion(points, physics.local_floor(pose.t, motion.fps), motion.fps)


def mirror_window(window: Window, skeleton: Skeleton) -> Window:
    """The window mirrored left to right; its surroundings must be mirrored already."""
    flip = torch.tensor(MIRROR)
    return window._replace(
        R_parent_joint=mirrored_rotations(window.R_parent_joint, skeleton),
        R_world_head=window.R_world_head * torch.outer(flip, flip),
        t_world_head=window.t_world_head * flip,
        t_parent_joint=window.t_parent_joint[joint_twins(skeleton)] * flip,
        foot_contact=window.foot_contact.flip(-1),
    )


def mirrored_rotations(
    R_parent_joint: Float[Tensor, "*batch joint 3 3"], skeleton: Skeleton
) -> Float[Tensor, "*batch joint 3 3"]:
    """Local rotations of the pose mirrored left to right."""
    flip = R_parent_joint.new_tensor(MIRROR)
    return R_parent_joint[..., joint_twins(skeleton), :, :] * torch.outer(flip, flip)


def joint_twins(skeleton: Skeleton) -> list[int]:
    """Index of each joint's counterpart on the other side."""
    return [skeleton.index(mirrored_name(name)) for name in skeleton.joint_names]


def mirrored_name(name: str) -> str:
    """The name with left and right exchanged; unchanged for joints on the midline."""
    for side, other in (("left", "right"), ("right", "left")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


class SeededSampler(Sampler):
    """Weighted random samples of (window, seed), for epochs of a fixed number of steps.

    The sample at a step depends on seed, epoch and position alone: a resumed run continues with the same samples, and
    the ranks of a distributed run split one sequence.
    """

    def __init__(self, weights: Tensor, count: int, seed: int, rank: int = 0, world: int = 1):
        self.weights, self.count, self.seed = weights, count, seed
        self.rank, self.world, self.epoch = rank, world, 0

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning at the start of every epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count // self.world

    def __iter__(self) -> Iterator[tuple[int, int]]:
        random = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
        windows = torch.multinomial(self.weights, self.count, replacement=True, generator=random)
        seeds = torch.randint(2**62, (self.count,), generator=random)
        usable = slice(self.rank, self.count - self.count % self.world, self.world)
        yield from zip(windows[usable].tolist(), seeds[usable].tolist())


class FixedSampler(Sampler):
    """Evenly spread windows with fixed seeds, so that every validation uses the same noise."""

    def __init__(self, windows: int, limit: int | None = None):
        count = min(windows, limit or windows)
        self.items = [(k * windows // count, k) for k in range(count)]

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self.items)
