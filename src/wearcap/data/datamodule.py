"""Windows for Lightning: datasets and loaders, composed and nothing else."""

import lightning
from torch.utils.data import DataLoader

from wearcap.data.statistics import collate
from wearcap.data.windows import FixedSampler, SeededSampler, Source, WindowDataset


class MotionWindows(lightning.LightningDataModule):
    """Training windows drawn afresh each epoch by seed, validation windows always the same."""

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
    ):
        """`sources` maps a name to {root, weight}; `val_sources` (default: the same) are validated on.

        An epoch has `steps_per_epoch` steps of `batch_size` windows, however many windows there are. `balance`: see
        `WindowDataset`; it is for training alone.
        """
        super().__init__()
        self.sources = [Source(**source) for source in sources.values() if source]
        self.val_sources = [Source(**source) for source in (val_sources or sources).values() if source]
        self.window, self.stride, self.fps = window, stride, fps
        self.batch_size, self.steps_per_epoch, self.val_windows = batch_size, steps_per_epoch, val_windows
        self.workers, self.seed, self.augment, self.balance = workers, seed, augment, balance

    def dataset(self, split: str) -> WindowDataset:
        """Windows of a split; the training split is jittered and mirrored."""
        train = split == "train"
        return WindowDataset(
            self.sources if train else self.val_sources, split, window=self.window, stride=self.stride, fps=self.fps,
            mirror=self.augment and train, balance=self.balance if train else 1.0,
        )  # fmt: skip

    def setup(self, stage: str) -> None:
        if stage == "fit":
            self.train, self.val = self.dataset("train"), self.dataset("val")

    def _world(self) -> dict[str, int]:
        return {"rank": self.trainer.global_rank, "world": self.trainer.world_size} if self.trainer else {}

    def train_dataloader(self) -> DataLoader:
        world = self._world()
        count = self.steps_per_epoch * self.batch_size * world.get("world", 1)
        sampler = SeededSampler(self.train.weights, count, self.seed, **world)
        return self._loader(self.train, sampler)

    def val_dataloader(self) -> DataLoader:
        return self._loader(self.val, FixedSampler(len(self.val), self.val_windows))

    def _loader(self, dataset: WindowDataset, sampler) -> DataLoader:
        return DataLoader(
            dataset, self.batch_size, sampler=sampler, num_workers=self.workers, collate_fn=collate,
            persistent_workers=self.workers > 0,
            # A forked worker can inherit a held lock of the main process's threads and hang.
            multiprocessing_context="forkserver" if self.workers else None, pin_memory=self.trainer is not None and self._on_gpu(),
        )  # fmt: skip

    def _on_gpu(self) -> bool:
        return self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"
