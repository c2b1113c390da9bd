"""Windows of recordings, sliced from the memory map; content and order are functions of seed and step."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from wearcap.body.skeleton import Skeleton
from wearcap.data.floor import floor_beneath
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording.store import RecordingFile, RecordingStore

_FLIP = (1.0, -1.0, 1.0)


class Window(NamedTuple):
    """One window, or a batch of them (a leading "batch" axis on every field); frames beyond a clip are padding."""

    R_parent_joint: Float[Tensor, "*batch time joint 3 3"]
    R_world_head: Float[Tensor, "*batch time 3 3"]
    t_world_head: Float[Tensor, "*batch time 3"]
    floor_height: Float[Tensor, "*batch time"]
    valid: Bool[Tensor, "*batch time"]
    t_parent_joint: Float[Tensor, "*batch joint 3"]
    stature: Float[Tensor, "*batch"]
    """Height of the head joint in the rest pose (m)."""
    noise: Float[Tensor, "*batch time motion"]
    level: Float[Tensor, "*batch 1"]
    """Diffusion noise and level, drawn here so that they depend on seed and step and not on the process."""


@dataclass(frozen=True)
class Source:
    """One data set to draw windows from, with its share of the draws."""

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
) -> tuple[list[Path], Int64[Tensor, "window 3"], Float64[Tensor, "window"]]:
    """Recordings of a split, its windows as (recording, first frame, frames of the recording), their shares of the draws.

    Recordings shorter than `min_frames` are left out. Raises WearcapError for one of another rate than `fps`, and
    where no window is left.
    """
    paths: list[Path] = []
    starts, weights = [], []
    for source in sources:
        store = RecordingStore.open(source.root)
        rows = [
            (store.root / store.entries[name].file, store.entries[name].frames)
            for name in _usable(store, split, fps, min_frames)
        ]
        counts = [max(0, frames - window) // stride + 1 for _, frames in rows]
        total = sum(count**balance for count in counts)
        for (path, frames), count in zip(rows, counts):
            starts += [(len(paths), k * stride, frames) for k in range(count)]
            weights += [source.weight * count ** (balance - 1) / total] * count
            paths.append(path)
    if not starts:
        raise WearcapError(f"no windows in split {split!r}", where=", ".join(s.root for s in sources),
                           expected=f"recordings of at least {min_frames} frames")  # fmt: skip
    return paths, torch.tensor(starts), torch.tensor(weights, dtype=torch.float64)


def _usable(store: RecordingStore, split: str, fps: float, min_frames: int) -> Iterator[str]:
    for name in store.names(split):
        entry = store.entries[name]
        if abs(entry.fps - fps) > 0.01 * fps:
            raise WearcapError(f"recording {name!r} has {entry.fps} frames per second", where=store.root,
                               expected=f"{fps}", fix="Prepare the data set at that rate.")  # fmt: skip
        if entry.frames >= min_frames:
            yield name


class WindowDataset(Dataset):
    """Windows of one split of one or more data sets. An item is asked for by (window, seed), or by its window alone."""

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
    ):
        """A recording's share of the draws grows with its number of windows to the power of `balance`.

        1 draws all windows alike, 0 all recordings.
        """
        self.window, self.stride, self.fps, self.mirror = window, stride, fps, mirror
        self.paths, self.starts, self.weights = share_out(
            sources, split, window=window, stride=stride, fps=fps, balance=balance, min_frames=min_frames
        )

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, item: tuple[int, int] | int) -> Window:
        # A number alone comes from Lightning's overfit_batches, which puts its own sampler in: same noise each time.
        index, seed = item if isinstance(item, tuple) else (item, item)
        random = torch.Generator().manual_seed(seed)
        recording, start, frames = self.starts[index].tolist()
        shift, mirrored = torch.rand(2, generator=random).tolist()
        if self.mirror:
            start = min(start + int(shift * self.stride), max(frames - self.window, 0))
        window = read_window(_open(self.paths[recording]), start, self.window, random)
        return (
            mirror_window(window, _part(self.paths[recording])) if self.mirror and mirrored < 0.5 else window
        )


@cache
def _open(path: Path) -> RecordingFile:
    """Kept open per process: a window then costs its own bytes alone."""
    return RecordingFile(path)


@cache
def _part(path: Path) -> Skeleton:
    return _open(path).part("motion").skeleton


@cache
def _constants(path: Path) -> tuple[Tensor, Tensor, Rigid]:
    """Offsets, stature and T_device_head of a recording."""
    file, skeleton = _open(path), _part(path)
    stature = torch.tensor(skeleton.height_of("head"))
    mount = Rigid(file.tensor("head.R_head_device"), file.tensor("head.t_head_device"))
    if file.length("head.timestamps") != file.length("motion.timestamps"):
        raise WearcapError("head and motion have different lengths", where=path,
                           expected="both on one clock", fix="Prepare the recording again.")  # fmt: skip
    return skeleton.t_parent_joint, stature, mount.inverse()


@cache
def _floor(path: Path) -> Tensor:
    """Floor height beneath every frame, as the pipelines find it."""
    recording = _open(path).load()
    assert recording.head is not None
    return floor_beneath(
        recording, recording.head.timestamps, recording.head.T_world_head.t, _part(path).height_of("head")
    )


def read_window(file: RecordingFile, start: int, length: int, random: torch.Generator) -> Window:
    """Frames start…start+length-1 of a recording, the last frame repeated as padding behind its end."""
    offsets, stature, T_device_head = _constants(file.path)
    stop = min(start + length, file.length("motion.timestamps"))
    take = torch.arange(length).clamp_max(stop - start - 1)
    T_world_device = Rigid(
        file.window("head.R_world_device", start, stop), file.window("head.t_world_device", start, stop)
    )
    T_world_head = (T_world_device @ T_device_head)[take]
    floor = _floor(file.path)[start:stop][take]
    R_parent_joint = file.window("motion.R_parent_joint", start, stop)[take]
    return Window(
        R_parent_joint=R_parent_joint,
        R_world_head=T_world_head.R,
        t_world_head=T_world_head.t,
        floor_height=floor,
        valid=torch.arange(length) < stop - start,
        t_parent_joint=offsets,
        stature=stature,
        noise=torch.randn(length, 6 * len(offsets), generator=random),
        level=torch.rand(1, generator=random),
    )


def mirror_window(window: Window, skeleton: Skeleton) -> Window:
    """The same motion seen in a mirror that swaps left and right."""
    flip = torch.tensor(_FLIP)
    return window._replace(
        R_parent_joint=mirrored_rotations(window.R_parent_joint, skeleton),
        R_world_head=window.R_world_head * torch.outer(flip, flip),
        t_world_head=window.t_world_head * flip,
        t_parent_joint=window.t_parent_joint[_twins(skeleton)] * flip,
    )


def mirrored_rotations(
    R_parent_joint: Float[Tensor, "*batch joint 3 3"], skeleton: Skeleton
) -> Float[Tensor, "*batch joint 3 3"]:
    """A pose seen in a mirror that swaps left and right."""
    flip = R_parent_joint.new_tensor(_FLIP)
    return R_parent_joint[..., _twins(skeleton), :, :] * torch.outer(flip, flip)


def _twins(skeleton: Skeleton) -> list[int]:
    return [skeleton.index(mirrored_name(name)) for name in skeleton.joint_names]


def mirrored_name(name: str) -> str:
    """left_… for right_… and the other way round; the name itself on the midline."""
    for side, other in (("left", "right"), ("right", "left")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


class SeededSampler(Sampler):
    """Weighted draws of (window, seed), for one epoch of a fixed number of steps.

    What is drawn at a step depends on seed, epoch and position alone: a resumed run continues with the same
    samples, and ranks of a distributed run share out one sequence.
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
    """Evenly spread windows, each with its own fixed seed: validation sees the same noise every time."""

    def __init__(self, windows: int, limit: int | None = None):
        count = min(windows, limit or windows)
        self.items = [(k * windows // count, k) for k in range(count)]

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self.items)
