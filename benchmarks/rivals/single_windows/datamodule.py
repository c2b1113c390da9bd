"""The Lightning DataModule of every training."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol, runtime_checkable

import lightning
from torch import Tensor
from torch.utils.data import DataLoader

from benchmarks.rivals.single_windows.windows import FixedSampler, SeededSampler, Source, collate


@runtime_checkable
class _Drawn(Protocol):
    """A data set with sampling weights, indexed by (sample, seed)."""

    weights: Tensor

    def __len__(self) -> int: ...

    def __getitem__(self, item: tuple[int, int]) -> tuple[Tensor, ...]: ...


@dataclass(frozen=True)
class Loading:
    """How samples are drawn and loaded."""

    batch_size: int
    steps_per_epoch: int | None = None
    """Steps of an epoch, however many samples there are; None: as many as there are samples."""
    val_windows: int | None = None
    """Number of samples, evenly spread, of a validation; None: all."""
    workers: int = 0
    """Number of processes that load samples; 0: the training's own."""
    seed: int = 0


class WindowsModule(lightning.LightningDataModule):
    """Training samples drawn anew each epoch from a seed; fixed validation samples."""

    def __init__(
        self,
        dataset: Callable[[list[Source], str, bool], _Drawn],
        loading: Loading,
        sources: dict[str, dict | None] | None = None,
        val_sources: dict[str, dict | None] | None = None,
        augment: bool = True,
    ):
        """`sources` maps a name to {root, weight}; `val_sources` (default: the same) are validated on.

        `dataset` makes the data set of sources, a split, and whether its samples are augmented, which those of the
        training split are unless `augment` is off.
        """
        super().__init__()
        self.sources = [Source(**source) for source in (sources or {}).values() if source]
        self.val_sources = [Source(**source) for source in (val_sources or sources or {}).values() if source]
        self.loading, self.augment, self._dataset = loading, augment, dataset
        self.dataset = cache(self._made)
        """The data set of a split; the statistics' is the training's own."""

    def _made(self, split: str) -> _Drawn:
        train = split == "train"
        return self._dataset(self.sources if train else self.val_sources, split, train and self.augment)

    def setup(self, stage: str) -> None:
        if stage == "fit":
            self.train, self.val = self.dataset("train"), self.dataset("val")

    def train_dataloader(self) -> DataLoader:
        world = {"rank": self.trainer.global_rank, "world": self.trainer.world_size} if self.trainer else {}
        steps = self.loading.steps_per_epoch or max(1, len(self.train) // self.loading.batch_size)
        count = steps * self.loading.batch_size * world.get("world", 1)
        return self._loader(self.train, SeededSampler(self.train.weights, count, self.loading.seed, **world))

    def val_dataloader(self) -> DataLoader:
        return self._loader(self.val, FixedSampler(len(self.val), self.loading.val_windows))

    def _loader(self, dataset: _Drawn, sampler: SeededSampler | FixedSampler) -> DataLoader:
        workers = self.loading.workers
        return DataLoader(
            dataset,  # pyright: ignore[reportArgumentType]
            self.loading.batch_size,
            sampler=sampler,
            num_workers=workers,
            collate_fn=collate,
            persistent_workers=workers > 0,
            # A forked worker can inherit a held lock of the main process's threads and hang.
            multiprocessing_context="forkserver" if workers else None,
            pin_memory=self.trainer is not None and self.trainer.strategy.root_device.type == "cuda",
        )
