"""The Lightning DataModule of every training."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, runtime_checkable

import lightning
import torch
from jaxtyping import Int64
from torch import Tensor

from wearcap.data.windows import Source, drawn

ON_DEVICE = 0.6
"""Share of a device's free memory that recordings may take; larger data sets stay in the host's memory."""


@runtime_checkable
class _Drawn(Protocol):
    """A data set with sampling weights, of which whole batches are drawn."""

    weights: Tensor

    def __len__(self) -> int: ...

    def batch(self, index: Int64[Tensor, "batch"], seed: Int64[Tensor, "batch"]) -> Any: ...


@dataclass(frozen=True)
class Loading:
    """How samples are drawn."""

    batch_size: int
    steps_per_epoch: int | None = None
    """Steps of an epoch, however many samples there are; None: as many as there are samples."""
    val_windows: int | None = None
    """Number of samples, evenly spread, of a validation; None: all."""
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
            for dataset in (self.train, self.val):
                place(dataset, self._device)

    @property
    def _device(self) -> torch.device:
        return self.trainer.strategy.root_device if self.trainer else torch.device("cpu")

    def train_dataloader(self) -> "Batches":
        size, seed, trainer = self.loading.batch_size, self.loading.seed, self.trainer
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)
        steps = self.loading.steps_per_epoch or max(1, len(self.train) // size)
        upto = self.train.weights.cumsum(0)

        def numbered(step: int) -> tuple[Tensor, Tensor]:
            """Windows and seeds of a step: ranks take turns in one sequence, which goes on from epoch to epoch."""
            fixed = trainer is not None and trainer.overfit_batches > 0  # pyright: ignore[reportAttributeAccessIssue]
            epoch = 0 if trainer is None or fixed else trainer.current_epoch
            first = (epoch * steps + step) * size * world + rank
            numbers = (seed << 40) + first + world * torch.arange(size, device=upto.device)
            return drawn(upto, numbers), numbers

        return Batches(self.train, steps, numbered, self._device)

    def val_dataloader(self) -> "Batches":
        count, size = min(len(self.val), self.loading.val_windows or len(self.val)), self.loading.batch_size

        def numbered(step: int) -> tuple[Tensor, Tensor]:
            """Evenly spread windows with fixed seeds, so that every validation uses the same noise."""
            seeds = torch.arange(step * size, min(count, (step + 1) * size), device=self.val.weights.device)
            return seeds * len(self.val) // count, seeds

        return Batches(self.val, -(-count // size), numbered, self._device)


def place(dataset: _Drawn, device: torch.device) -> None:
    """Move a data set that can be drawn on a device onto it, if it fits."""
    packed = getattr(dataset, "packed", None)
    if device.type == "cuda" and packed is not None and packed.bytes < ON_DEVICE * torch.cuda.mem_get_info(device)[0]:
        dataset.to(device)  # pyright: ignore[reportAttributeAccessIssue]


class Batches:
    """The batches of an epoch: on the device that holds the recordings as they are asked for, else one ahead of the step."""

    def __init__(
        self, dataset: _Drawn, count: int, numbered: Callable[[int], tuple[Tensor, Tensor]], device: torch.device
    ):
        """`numbered` gives the samples and seeds of a step; batches go to `device`."""
        self.data, self.count, self.numbered, self.device = dataset, count, numbered, device

    def __len__(self) -> int:
        return self.count

    def _batch(self, step: int) -> Any:
        with torch.no_grad():
            batch = self.data.batch(*self.numbered(step))
        if batch[0].device == self.device or self.device.type != "cuda":
            return batch
        return type(batch)(*(value.pin_memory().to(self.device, non_blocking=True) for value in batch))

    def __iter__(self) -> Iterator[Any]:
        if self.data.weights.device.type != "cpu":
            yield from map(self._batch, range(self.count))
            return
        with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) as ahead:
            coming = ahead.submit(self._batch, 0)
            for step in range(self.count):
                batch = coming.result()
                if step + 1 < self.count:
                    coming = ahead.submit(self._batch, step + 1)
                yield batch
