"""Voxel grids of the points around the body, sampled from recordings as a function of seed and step."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.utils.data import Dataset

from wearcap.data.datamodule import SeededWindows
from wearcap.data.windows import Source, requested, share_out
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording.store import RecordingFile
from wearcap.scene.voxels import VoxelGrid, VoxelMap, mirrored

_MAPS_AT_ONCE = 512


class Places(NamedTuple):
    """Voxel grids (truncated distances, m) of some frames, or a batch of them (a leading "batch" axis)."""

    grids: Float[Tensor, "*batch time x y z"]


@dataclass(frozen=True)
class Surveyed:
    """A recording's map of points, and the device's path through it."""

    map: VoxelMap
    T_world_device: Rigid
    timestamps: Float64[Tensor, "time"]


class PlaceDataset(Dataset):
    """Voxel grids of random frames of each window of a split, of recordings that have points.

    Items are indexed by (window, seed), or by window alone.
    """

    def __init__(
        self,
        sources: list[Source],
        split: str,
        *,
        grid: VoxelGrid,
        window: int,
        frames: int,
        fps: float,
        mirror: bool = False,
        balance: float = 1.0,
    ):
        """`frames` are drawn from every window of `window` frames; `balance`: see `WindowDataset`.

        Raises WearcapError when no recording has points, and as `share_out` does.
        """
        self.grid, self.window, self.frames, self.mirror = grid, window, frames, mirror
        self.recordings, starts, weights = share_out(
            sources, split, window=window, stride=window, fps=fps, balance=balance, min_frames=1
        )
        pointed = torch.tensor([_has_points(store.path_of(name)) for store, name in self.recordings])[starts[:, 0]]
        self.starts, self.weights = starts[pointed], weights[pointed]
        if not pointed.any():
            raise WearcapError(
                f"no recording of split {split!r} has points",
                where=", ".join(s.root for s in sources),
                expected="recordings with the points that tracking found",
            )

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, item: tuple[int, int] | int) -> Places:
        index, random = requested(item)
        recording, start, count = self.starts[index].tolist()
        store, name = self.recordings[recording]
        chosen = start + torch.randint(min(self.window, count - start), (self.frames,), generator=random)
        survey = _survey(store.path_of(name), self.grid)
        grids = survey.map.voxelize(survey.T_world_device[chosen], survey.timestamps[chosen])
        flipped = self.mirror and torch.rand((), generator=random) < 0.5
        return Places(mirrored(grids) if flipped else grids)


def _has_points(path: Path) -> bool:
    file = RecordingFile(path)
    return "points.points_world" in file.keys and file.length("points.points_world") > 0


@lru_cache(_MAPS_AT_ONCE)
def _survey(path: Path, grid: VoxelGrid) -> Surveyed:
    file = RecordingFile(path)
    cloud, head, surroundings = file.part("points"), file.part("head"), VoxelMap(grid)
    surroundings.add(cloud.points_world, cloud.first_seen)
    return Surveyed(surroundings, head.T_world_device, head.timestamps)


class PlaceWindows(SeededWindows):
    """Lightning data of the voxel autoencoder's training."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        grid: VoxelGrid,
        window: int,
        frames: int,
        fps: float,
        batch_size: int,
        steps_per_epoch: int,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        balance: float = 1.0,
        val_sources: dict[str, dict | None] | None = None,
    ):
        """See `SeededWindows` and `PlaceDataset`; a batch holds `batch_size` windows of `frames` grids each."""
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.grid, self.window, self.frames, self.fps, self.balance = grid, window, frames, fps, balance

    def dataset(self, split: str) -> PlaceDataset:
        """Grids of a split; half of the training split's are mirrored."""
        train = split == "train"
        return PlaceDataset(
            self.sources if train else self.val_sources,
            split,
            grid=self.grid,
            window=self.window,
            frames=self.frames,
            fps=self.fps,
            mirror=train,
            balance=self.balance if train else 1.0,
        )
