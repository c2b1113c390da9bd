"""Windows of recordings for training, each drawn on its own; content and order are functions of seed and step.

A `Windows` data set cuts windows out of the recordings of stores. A system's `Content` says what is read of them and what
a batch holds; the augmentations of `transforms.py` stand between the two.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Int64
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from benchmarks.rivals.single_windows.bodies import OtherBodies, OtherPerson
from benchmarks.rivals.single_windows.transforms import Cut, Draws, TimeStretch, TimeTransform, Transform, Window
from wearcap.data.arm_mixing import ArmDonors
from wearcap.errors import WearcapError
from wearcap.recording.store import RecordingFile, RecordingStore

W = TypeVar("W", bound=tuple)


@dataclass(frozen=True)
class Source:
    """One data set to sample windows from, with its sampling weight."""

    root: str
    weight: float = 1.0
    bodies: bool = True
    """Whether other people do its motion, too, where there are any (`OtherBodies`)."""


class Content:
    """What the windows of a system are made of; each system has its own."""

    draws: ClassVar[tuple[str, ...]] = ()
    """Names of the uniform numbers that are drawn first for every sample, in this order (`Draws`)."""
    requires: ClassVar[str] = ""
    """What usable recordings have, as the end of the message when none is (" with points")."""
    any_body: ClassVar[bool] = False
    """Whether `open` can give a motion to people of other proportions."""
    tracks_at_once: ClassVar[int | None] = None
    """Number of tracks that are kept in memory; None: all."""

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        """Make or check what reading the recordings of a split needs."""

    def usable(self, store: RecordingStore, name: str) -> bool:
        """Whether windows are cut out of a recording."""
        return True

    def min_frames(self, window: int, stretch: float) -> int:
        """Fewest frames of a recording, at the rate of the windows, of which up to `stretch` times as many are read."""
        return window

    def cut(self, track: Any, start: int, frames: int, every: int, windows: "Windows") -> Cut:
        """The cut of an unchanged window, in frames of the track; `start` and `frames` are the recording's."""
        stride = windows.stride * every
        return Cut(start, windows.window, frames, stride=stride, step=every, stretch=windows.stretch)

    def varied(self, store: RecordingStore, name: str) -> bool:
        """Whether a recording's motion can be given to people of other proportions: if no objects are handled."""
        keys = open_recording(store.path_of(name)).keys
        return self.any_body and not any(key.startswith("object_motion.") for key in keys)

    def open(self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None) -> Any:
        """The track of a recording: what is kept of it in memory, for `read` to cut windows out of.

        `person`: somebody else who does the same, for recordings that are `varied`; None: as recorded.
        """
        raise NotImplementedError

    def read(self, track: Any, cut: Cut, random: Draws) -> Window:
        """The values of a window."""
        raise NotImplementedError

    def item(self, track: Any, cut: Cut, window: Window, random: Draws) -> tuple[Tensor, ...]:
        """The batch item (a named tuple) of a transformed window."""
        raise NotImplementedError


class Windows(Dataset):
    """Windows of one split of one or more data sets, indexed by (window, seed).

    An index without a seed comes from Lightning's overfit_batches, which replaces the sampler: the index is the seed.
    Recordings are opened at their first use and kept in memory, in every process.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        split: str,
        augmented: bool = False,
        *,
        content: Content,
        window: int,
        stride: int,
        fps: float,
        every: int | None = 1,
        balance: float = 1.0,
        bodies: OtherBodies | None = None,
        transforms: dict[str, TimeTransform | Transform | None] | None = None,
    ):
        """Windows of `window` frames at `fps` that begin `stride` frames apart; `every`-th frames of recordings are used.

        `every` None takes recordings at any multiple of `fps`. `transforms` by name apply to `augmented` windows, those
        of time first, each group in its order. In training a recording is drawn in proportion to its number of windows
        to the power of `balance`: 1 samples all windows equally, 0 all recordings. `bodies` do the motion of `augmented`
        windows in turn with the wearer, where the content is `varied`. Raises WearcapError for a recording
        at another rate, and when there are no windows.
        """
        self.content, self.window, self.stride, self.fps = content, window, stride, fps
        chosen = [each for each in (transforms or {}).values() if each is not None] if augmented else []
        self.in_time = tuple(each for each in chosen if isinstance(each, TimeTransform))
        self.in_space = tuple(each for each in chosen if not isinstance(each, TimeTransform))
        self.stretch = max((each.factor for each in self.in_time if isinstance(each, TimeStretch)), default=1.0)
        self.recordings: list[tuple[RecordingStore, str, int]] = []
        self._varied: list[bool] = []
        self.bodies = bodies if augmented else None
        self._tracks: dict[tuple[int, int], Any] = {}
        self._donors: dict[Path, ArmDonors] = {}
        stores = [RecordingStore.open(source.root) for source in sources]
        content.prepare(stores, split)
        least, starts, weights = content.min_frames(window, self.stretch), [], []
        for source, store in zip(sources, stores):
            rate, found = _rows(store, split, fps, every)
            rows = [(name, frames) for name, frames in found if frames >= least * rate]
            counts = [max(0, frames - window * rate) // (stride * rate) + 1 for _, frames in rows]
            power = balance if split == "train" else 1.0
            total = sum(count**power for count in counts)
            for (name, frames), count in zip(rows, counts):
                if content.usable(store, name):
                    starts += [(len(self.recordings), k * stride * rate, frames) for k in range(count)]
                    weights += [source.weight * count ** (power - 1) / total] * count
                self.recordings.append((store, name, rate))
                self._varied.append(source.bodies)
        if not starts:
            what = f"no windows in split {split!r}"
            expected = f"recordings of at least {least} frames{content.requires}"
            raise WearcapError(what, where=", ".join(source.root for source in sources), expected=expected)
        self.starts, self.weights = torch.tensor(starts), torch.tensor(weights, dtype=torch.float64)

    def __len__(self) -> int:
        return len(self.starts)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_tracks": {}, "_donors": {}}

    def track(self, number: int, person: int = 0) -> Any:
        """A whole recording, by its index in `recordings`, of its wearer (0) or of one of the other `bodies`."""
        if (number, person) not in self._tracks:
            if len(self._tracks) == self.content.tracks_at_once:
                self._tracks.pop(next(iter(self._tracks)))
            self._tracks[number, person] = self.content.open(*self.recordings[number], self._other(number, person))
        return self._tracks[number, person]

    def _other(self, number: int, person: int) -> OtherPerson | None:
        """One of the other `bodies` who does a recording's motion; None for its wearer."""
        if self.bodies is None or not person:
            return None
        seed = 1_000_003 * number + person
        donors = self._arm_donors(self.recordings[number][0]) if self.bodies.moves_other_arms(seed) else None
        return OtherPerson(self.bodies.proportions(seed), seed, donors)

    def _arm_donors(self, store: RecordingStore) -> ArmDonors:
        """The recordings of a store that windows are cut out of and in which no objects are handled."""
        if store.root not in self._donors:
            cut = {
                self.recordings[number][1]
                for number in self.starts[:, 0].unique().tolist()
                if self.recordings[number][0].root == store.root
            }
            names = [name for name in sorted(cut) if self.content.varied(store, name)]
            self._donors[store.root] = ArmDonors([open_recording(store.path_of(name)) for name in names])
        return self._donors[store.root]

    def _person(self, number: int, seed: int) -> int:
        """Who does the motion of a sample."""
        if self.bodies is None or not self._varied[number] or not self.content.varied(*self.recordings[number][:2]):
            return 0
        return seed % (self.bodies.count + 1)

    def __getitem__(self, item: tuple[int, int] | int) -> tuple[Tensor, ...]:
        index, seed = item if isinstance(item, tuple) else (item, item)
        number, start, frames = self.starts[index].tolist()
        random = Draws(seed, self.content.draws)
        track = self.track(number, self._person(number, seed))
        cut = self.content.cut(track, start, frames, self.recordings[number][2], self)
        for transform in self.in_time:
            cut = transform.retimed(cut, random)
        window = replace(self.content.read(track, cut, random), fps=self.fps)
        for transform in self.in_space:
            window = transform(window, random)
        return self.content.item(track, cut, window, random)

    def batch(self, index: Int64[Tensor, "batch"], seed: Int64[Tensor, "batch"]) -> Any:
        """Windows one by one, stacked along a leading batch axis."""
        return collate([self[item] for item in zip(index.tolist(), seed.tolist())])


def _rows(store: RecordingStore, split: str, fps: float, every: int | None) -> tuple[int, list[tuple[str, int]]]:
    """How many frames of a data set make one of a window, and names and lengths of a split's recordings.

    Raises WearcapError for rates that are not `every` times `fps`, or without `every` not the same whole multiple of it.
    """
    entries = [store.entries[name] for name in store.names(split)]
    rates = {entry.fps for entry in entries}
    if every is None:
        rate = next(iter(rates), fps)
        if len(rates) > 1 or abs(rate / fps - round(rate / fps)) > 0.01:
            what = f"recordings of {', '.join(f'{each:g}' for each in sorted(rates))} frames per second"
            expected = f"one rate that is a whole multiple of {fps:g}"
            raise WearcapError(what, where=store.root, expected=expected, fix="Prepare the data set at such a rate.")
        every = round(rate / fps)
    for name, entry in zip(store.names(split), entries):
        if abs(entry.fps - fps * every) > 0.01 * fps * every:
            what = f"recording {name!r} has {entry.fps} frames per second"
            fix = "Prepare the data set at that rate."
            raise WearcapError(what, where=store.root, expected=f"{fps * every}", fix=fix)
    return every, [(name, entry.frames) for name, entry in zip(store.names(split), entries)]


@cache
def open_recording(path: Path) -> RecordingFile:
    """A recording's file, which stays open per process, so that a window reads its own bytes only."""
    return RecordingFile(path)


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


def collate(windows: Sequence[W]) -> W:
    """Stacks windows (named tuples of tensors) along a leading batch axis."""
    return type(windows[0])(*(torch.stack(field) for field in zip(*windows)))
