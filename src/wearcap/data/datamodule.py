"""Lightning DataModules of windows."""

from collections.abc import Sized
from typing import Protocol, runtime_checkable

import lightning
from torch import Tensor
from torch.utils.data import DataLoader

from wearcap.data.statistics import collate
from wearcap.data.surroundings import NOTHING, Surroundings
from wearcap.data.windows import FixedSampler, SeededSampler, Source, WindowDataset
from wearcap.recording.store import RecordingStore


@runtime_checkable
class Drawn(Sized, Protocol):
    """A dataset of windows with sampling weights, indexed by (window, seed)."""

    weights: Tensor

    def __getitem__(self, item: tuple[int, int]) -> tuple[Tensor, ...]: ...


class SeededWindows(lightning.LightningDataModule):
    """Training windows sampled anew each epoch from a seed; fixed validation windows."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        batch_size: int,
        steps_per_epoch: int | None,
        val_windows: int | None,
        workers: int,
        seed: int,
        val_sources: dict[str, dict | None] | None,
    ):
        """`sources` maps a name to {root, weight}; `val_sources` (default: the same) are validated on.

        An epoch has `steps_per_epoch` steps of `batch_size` windows, however many windows there are; None: as many
        as there are windows.
        """
        super().__init__()
        self.sources = [Source(**source) for source in sources.values() if source]
        self.val_sources = [Source(**source) for source in (val_sources or sources).values() if source]
        self.batch_size, self.steps_per_epoch, self.val_windows = batch_size, steps_per_epoch, val_windows
        self.workers, self.seed = workers, seed

    def dataset(self, split: str) -> Drawn:
        """Windows of a split; the training split is augmented."""
        raise NotImplementedError

    def setup(self, stage: str) -> None:
        if stage == "fit":
            self.train, self.val = self.dataset("train"), self.dataset("val")

    def _world(self) -> dict[str, int]:
        return {"rank": self.trainer.global_rank, "world": self.trainer.world_size} if self.trainer else {}

    def train_dataloader(self) -> DataLoader:
        world = self._world()
        steps = self.steps_per_epoch or max(1, len(self.train) // self.batch_size)
        count = steps * self.batch_size * world.get("world", 1)
        sampler = SeededSampler(self.train.weights, count, self.seed, **world)
        return self._loader(self.train, sampler)

    def val_dataloader(self) -> DataLoader:
        return self._loader(self.val, FixedSampler(len(self.val), self.val_windows))

    def _loader(self, dataset: Drawn, sampler) -> DataLoader:
        return DataLoader(
            dataset,
            self.batch_size,
            sampler=sampler,
            num_workers=self.workers,
            collate_fn=collate,
            persistent_workers=self.workers > 0,
            # A forked worker can inherit a held lock of the main process's threads and hang.
            multiprocessing_context="forkserver" if self.workers else None,
            pin_memory=self.trainer is not None and self._on_gpu(),
        )

    def _on_gpu(self) -> bool:
        return self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"


class MotionWindows(SeededWindows):
    """Windows of head paths and motions, for HMD²'s training."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        window: int,
        stride: int,
        fps: float,
        batch_size: int,
        steps_per_epoch: int,
        val_windows: int = 256,
        workers: int = 1,
        seed: int = 0,
        augment: bool = True,
        balance: float = 1.0,
        val_sources: dict[str, dict | None] | None = None,
        surroundings: Surroundings = NOTHING,
        beginnings: float = 0.0,
    ):
        """See `SeededWindows`; `balance` and `beginnings` (training only): see `WindowDataset`."""
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.window, self.stride, self.fps = window, stride, fps
        self.augment, self.balance = augment, balance
        self.surroundings, self.beginnings = surroundings, beginnings

    def dataset(self, split: str) -> WindowDataset:
        """Windows of a split; the training split is shifted and mirrored. Missing codes of points are computed."""
        train = split == "train"
        sources = self.sources if train else self.val_sources
        if self.surroundings.places is not None:
            for source in sources:
                store = RecordingStore.open(source.root)
                self.surroundings.places.prepare(store, store.names(split))
        return WindowDataset(
            sources,
            split,
            window=self.window,
            stride=self.stride,
            fps=self.fps,
            mirror=self.augment and train,
            balance=self.balance if train else 1.0,
            surroundings=self.surroundings,
            beginnings=self.beginnings if train else 0.0,
        )
