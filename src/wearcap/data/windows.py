"""Windows of recordings for training, drawn in batches; content and order are functions of seed and step.

A `Windows` data set packs the recordings of stores. A system's `Content` says what is kept of them and what a batch
holds; the augmentations of `transforms.py` stand between the two. Mean and scale of features over a training
split are computed of windows drawn from it, and saved with the weights.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int64
from joblib import cpu_count
from rich.progress import track as progress
from torch import Tensor

from wearcap.boundary.texts import read_json_object
from wearcap.data.arm_mixing import ArmDonors
from wearcap.data.batch import Batch, Transform
from wearcap.data.bodies import OtherBodies
from wearcap.data.draws import Draws
from wearcap.data.packing import Packed, Track, forget_old, kept, kept_track
from wearcap.data.transforms import Cutting, TimeStretch
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.models.layers import Normalizer
from wearcap.parallel import Parallel, divided
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.runtime.stages import code_digest, digest

MIN_SCALE = 0.05
"""Smallest standard deviation that features are divided by: rotations that hardly vary would become mostly noise."""
ARM_VERSIONS = 3
"""Number of tracks of a recording with the arms of others (`OtherBodies.arms`)."""
SPREAD, CHUNKS = 200, 8
"""Fewest recordings without a file that all cores pack, whose processes take seconds to start, and parts of them for each core."""
ARM_FRAMES = 240_000
"""About the most frames of a data set that arms are taken from; of larger ones, recordings evenly chosen."""


@dataclass(frozen=True)
class Source:
    """One data set to sample windows from, with its sampling weight."""

    root: str
    weight: float = 1.0
    bodies: bool = True
    """Whether other people do its motion, too, where there are any (`OtherBodies`)."""


class Content:
    """What the windows of a system are made of; each system has its own."""

    requires: ClassVar[str] = ""
    """What usable recordings have, as the end of the message when none is (" with points")."""
    any_body: ClassVar[bool] = False
    """Whether people of other proportions can do a motion."""
    own_rate: ClassVar[bool] = False
    """Whether a track has the rate of the windows, not the recording's."""
    sensed: frozenset[str] = frozenset()
    parts: frozenset[str] = frozenset()
    jumps: ClassVar[dict[str, str]] = {}
    """See `Batch`."""

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        """Make or check what reading the recordings of a split needs."""

    def settings(self) -> Any:
        """What decides, beside the code, what is kept of a recording."""

    def usable(self, store: RecordingStore, name: str) -> bool:
        """Whether windows are cut out of a recording."""
        return True

    def min_frames(self, window: int, stretch: float) -> int:
        """Fewest frames of a recording, at the rate of the windows, of which up to `stretch` times as many are read."""
        return window

    def twins(self, file: RecordingFile) -> dict[str, list[int]]:
        """What a mirror exchanges, by names of values (`Batch.twins`)."""
        return {}

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        """What is kept of a recording; of its frames, those of a content of `own_rate` only every `every`-th.

        Values of `parts` have an axis of the body's parts before their last one.
        """
        raise NotImplementedError

    def batch(self, batch: Batch) -> tuple[Tensor, ...]:
        """What a training step takes (a named tuple) of windows that were read and transformed."""
        raise NotImplementedError


class Windows:
    """Windows of one split of one or more data sets, drawn in batches on the device that holds the recordings."""

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
        transforms: dict[str, Cutting | Transform | None] | None = None,
    ):
        """Windows of `window` frames at `fps` that begin `stride` frames apart; `every`-th frames of recordings are used.

        `every` None takes recordings at any multiple of `fps`. `transforms` by name apply to `augmented` windows, those
        of frames first, each group in its order. In training a recording is drawn in proportion to its number of windows
        to the power of `balance`: 1 samples all windows equally, 0 all recordings. `bodies` do the motion of `augmented`
        windows in turn with the wearer, where nothing is handled. Raises WearcapError for a recording
        at another rate, and when there are no windows.
        """
        self.content, self.window, self.stride, self.fps = content, window, stride, fps
        self.bodies = bodies if augmented and content.any_body else None
        chosen = [each for each in (self.bodies, *(transforms or {}).values()) if each is not None] if augmented else []
        self.cutting = [each for each in chosen if isinstance(each, Cutting)]
        self.changing = [each for each in chosen if callable(each)]
        stretch = max((each.factor for each in chosen if isinstance(each, TimeStretch)), default=1.0)
        stores = [RecordingStore.open(source.root) for source in sources]
        content.prepare(stores, split)
        least, rows, found, cached = content.min_frames(window, stretch), [], list[_Chosen](), _Cached(content, stores)
        for source, store in zip(sources, stores):
            rate, entries = _rows(store, split, fps, every)
            entries = [(name, frames) for name, frames in entries if frames >= least * rate]
            counts = [max(0, frames - window * rate) // (stride * rate) + 1 for _, frames in entries]
            power = balance if split == "train" else 1.0
            total = sum(count**power for count in counts)
            for (name, _), count in zip(entries, counts):
                usable, handled = cached.facts(store, name)
                if usable:
                    step = 1 if content.own_rate else rate
                    rows += [(len(found), k * stride * step, step) for k in range(count)]
                    weight = source.weight * count ** (power - 1) / total
                    varied = self.bodies is not None and source.bodies and not handled
                    found.append(_Chosen(store, name, store.entries[name].sha256, rate, varied, count, weight))
        if not rows:
            what = f"no windows in split {split!r}"
            expected = f"recordings of at least {least} frames{content.requires}"
            raise WearcapError(what, where=", ".join(source.root for source in sources), expected=expected)
        if len(steps := {each.rate for each in found}) > 1 and not content.own_rate:
            raise WearcapError(f"recordings of {sorted(steps)} frames per frame of a window", expected="one rate")
        self.recordings, self.starts, self.step = found, torch.tensor(rows)[:, :2], rows[0][2]
        self.weights = torch.tensor([each.weight for each in found for _ in range(each.count)], dtype=torch.float64)
        self._pack(found, cached)

    def _pack(self, found: Sequence["_Chosen"], cached: "_Cached") -> None:
        """Keep the recordings' tracks, and those of people who move others' arms."""
        made, varied = [(each, 0) for each in found], [each.varied for each in found]
        versions = torch.arange(len(found))[:, None]
        if self.bodies is not None and self.bodies.arms and any(varied):
            versions = versions.repeat(1, ARM_VERSIONS)
            mixed = torch.tensor(varied).nonzero()[:, 0]
            versions[mixed] = len(found) + torch.arange(len(mixed) * ARM_VERSIONS).reshape(-1, ARM_VERSIONS)
            made += [(found[each], version) for each in mixed.tolist() for version in range(1, ARM_VERSIONS + 1)]
        self.packed = cached.packed(made, summed=self.bodies is None)
        self.varied, self.versions = torch.tensor(varied), versions

    def __len__(self) -> int:
        return len(self.starts)

    def to(self, device: torch.device) -> "Windows":
        """Draw on a device, which then holds all recordings."""
        self.packed.to(device)
        self.starts, self.weights = self.starts.to(device), self.weights.to(device)
        self.varied, self.versions = self.varied.to(device), self.versions.to(device)
        return self

    def cut(self, index: Int64[Tensor, "batch"], seed: Int64[Tensor, "batch"]) -> Batch:
        """The frames of windows by their numbers, each augmented by its seed."""
        track, start = self.starts[index].unbind(1)
        content = self.content
        batch = Batch(
            self.packed,
            Draws(seed),
            track,
            start,
            self.window,
            self.fps,
            stride=self.stride * self.step,
            step=self.step,
            twins=self.packed.twins,
            sensed=content.sensed,
            jumps=content.jumps,
            varied=self.varied[track],
            versions=self.versions[track],
            parts=content.parts if self.bodies is not None else frozenset(),
        )
        for transform in self.cutting:
            batch = transform.cut(batch)
        return batch

    def batch(self, index: Int64[Tensor, "batch"], seed: Int64[Tensor, "batch"]) -> Any:
        """Windows by their numbers, each augmented by its seed, as the system's training takes them."""
        batch = self.cut(index, seed).read()
        for transform in self.changing:
            batch = transform(batch)
        return self.content.batch(batch)


@dataclass(frozen=True)
class _Chosen:
    """A recording of which windows are cut, with their number and their weight in the draws."""

    store: RecordingStore
    name: str
    sha256: str
    rate: int
    varied: bool
    count: int
    weight: float

    @property
    def file(self) -> RecordingFile:
        return RecordingFile(self.store.path_of(self.name))


class _Cached:
    """What is made of recordings once, and kept in their data sets' caches."""

    def __init__(self, content: Content, stores: Sequence[RecordingStore]):
        modules = [each.__module__ for each in type(content).__mro__ if each.__module__.startswith("wearcap.")]
        key = digest(type(content).__qualname__, content.settings(), code_digest(*modules))[:24]
        self.content, self.folders = content, {each.root: each.root / "cache" / f"windows-{key}" for each in stores}
        self._known, self._new = {root: dict[str, tuple[bool, bool]]() for root in self.folders}, set[Path]()
        for root, folder in self.folders.items():
            with suppress(WearcapError, TypeError, ValueError):  # none yet, or a damaged file
                self._known[root] = {key: (a, b) for key, (a, b) in read_json_object(folder / "known.json").items()}
        self._arms = cache(self._arms_in)

    def facts(self, store: RecordingStore, name: str) -> tuple[bool, bool]:
        """Whether a recording is usable, and whether objects are handled in it, which other arms would not reach."""
        facts, sha256 = self._known[store.root], store.entries[name].sha256
        if sha256 not in facts:
            handled = any(key.startswith("object_motion.") for key in RecordingFile(store.path_of(name)).keys)
            facts[sha256] = self.content.usable(store, name), handled
            self._new.add(store.root)
        return facts[sha256]

    def packed(self, made: Sequence[tuple[_Chosen, int]], summed: bool) -> Packed:
        """Recordings and versions (not 0: with arms of others in their data set), `summed` over the body's parts or not."""
        for root in self._new:
            with suppress(WearcapError):  # a data set that is only read
                write_text(self.folders[root] / "known.json", json.dumps(self._known[root]))
        self.donors = [each for each, version in made if each.varied and not version]
        group = cache(lambda root: digest([each.sha256 for each in self.donors if each.store.root == root])[:16])
        names = [f"{each.sha256[:32]}-{each.rate}" + f"-{k}-{group(each.store.root)}" * (k > 0) for each, k in made]

        paths = [self.folders[each.store.root] / f"{name}.safetensors" for (each, _), name in zip(made, names)]

        def tracks() -> Iterator[Track]:
            self._spread([(each, path) for (each, version), path in zip(made, paths) if not version])
            for each, path in zip(progress(made, "packing recordings", transient=True, disable=len(made) < 8), paths):
                track = kept_track(path, partial(self._made, *each))
                yield _of_wearer(track, self.content.parts) if summed else track

        whole = self.folders[made[0][0].store.root] / f"joined-{digest(names, summed)[:24]}"
        packed = Packed(*kept(whole, tracks, [each.name for each, _ in made]))
        for used in (whole, *self.folders.values()):
            forget_old(used)
        return packed

    def _spread(self, made: Sequence[tuple[_Chosen, Path]]) -> None:
        """Make the missing files of many recordings on all cores."""
        missing = [(each, path) for each, path in made if not path.is_file()]
        if len(missing) < SPREAD or cpu_count() < 2:
            return
        chunks = divided(missing, -(-len(missing) // (CHUNKS * cpu_count())))
        done = Parallel().run(partial(_keep, self.content), chunks, missing[0][1].parent)
        for _ in progress(done, "packing recordings", len(chunks), transient=True):
            pass

    def _made(self, each: _Chosen, version: int) -> Track:
        recording = each.file.load()
        if version and recording.motion is not None:
            seed = int(each.sha256[:8], 16) + version
            mixed = self._arms(each.store.root).mixed(recording.motion, each.file, seed)
            recording = replace(recording, motion=mixed)
        return _track(self.content, each, recording)

    def _arms_in(self, root: Path) -> ArmDonors:
        donors = [each for each in self.donors if each.store.root == root]
        frames = sum(each.store.entries[each.name].frames for each in donors)
        return ArmDonors([each.file for each in donors[:: 1 + frames // ARM_FRAMES]])


def _track(content: Content, each: _Chosen, recording: Recording) -> Track:
    twins = {name: torch.tensor(order) for name, order in content.twins(each.file).items()}
    return replace(content.track(each.store, each.name, recording, each.rate), twins=twins)


def _keep(content: Content, made: Sequence[tuple[_Chosen, Path]]) -> None:
    """Write the files of some recordings, in a process of its own."""
    for each, path in made:
        kept_track(path, lambda each=each: _track(content, each, each.file.load()))


def _of_wearer(track: Track, parts: frozenset[str]) -> Track:
    """A track with sums over the body's parts."""
    values, constants = (
        {name: value.sum(-2) if name in parts else value for name, value in each.items()}
        for each in (track.values, track.constants)
    )
    return replace(track, values=values, constants=constants)


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


def drawn_batches(dataset: Any, limit: int, size: int | None = None) -> Iterator[Any]:
    """Batches of `size` (default: one batch) of `limit` windows, drawn by the data set's weights from a fixed seed."""
    numbers = torch.arange(limit, device=dataset.weights.device)
    for part in numbers.split(size or limit):
        yield dataset.batch(drawn(dataset.weights.cumsum(0), part), part)


def drawn(upto: Float[Tensor, "window"], numbers: Int64[Tensor, "batch"]) -> Int64[Tensor, "batch"]:
    """Windows of the draws of some numbers, by the sums of weights up to each window."""
    place = Draws(numbers).share("window") * upto[-1]
    return torch.searchsorted(upto, place, right=True).clamp_max(len(upto) - 1)


def standardize(normalizer: Normalizer, rows: Float[Tensor, "*batch feature"], min_scale: float = MIN_SCALE) -> None:
    """Set a normaliser to mean and standard deviation over all rows."""
    rows = rows.flatten(0, -2)
    normalizer.set(rows.mean(0), rows.std(0).clamp_min(min_scale))
