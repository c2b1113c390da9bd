"""Base classes of the LightningModules: seeded steps, optimiser from the config, logged losses."""

from collections.abc import Callable
from typing import Any

import lightning
import torch
from torch import Tensor


class SeededSteps(lightning.LightningModule):
    """Makes a step's randomness (dropout, augmentation) a function of seed and step, so that resumed runs repeat it."""

    seed: int

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        torch.manual_seed((self.seed + 1) * 1_000_003 + self.global_step * 64 + self.global_rank)


class GivenOptimizer(lightning.LightningModule):
    """Optimises `net` with the constructor's optimiser and, if there is one, scheduler, which advances every step."""

    _optimizer: Callable[..., torch.optim.Optimizer]
    _scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None

    def configure_optimizers(self):
        optimizer = self._optimizer(self.get_submodule("net").parameters())
        if self._scheduler is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": self._scheduler(optimizer), "interval": "step"}}


class Measured(GivenOptimizer):
    """Trains on the "loss" that `measure` returns, and logs all of its values, in training and validation."""

    def measure(self, batch: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """The "loss" of a batch and further values to log."""
        raise NotImplementedError

    def pipeline_parts(self) -> dict[str, Any]:
        """Constructor arguments of the pipeline that belong to the trained model."""
        raise NotImplementedError

    def _step(self, batch: tuple[Tensor, ...], stage: str) -> Tensor:
        measured = self.measure(batch)
        self.log_dict(
            {f"{stage}/{name}": value for name, value in measured.items()},
            batch_size=len(batch[0]),
            prog_bar=stage == "train",
            sync_dist=stage == "val",
            on_step=stage == "train",
            on_epoch=stage == "val",
        )
        return measured["loss"]

    def training_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> Tensor:
        return self._step(batch, "train")

    def validation_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> None:
        self._step(batch, "val")


class WeighedTerms(Measured):
    """The loss is the sum of `terms` times `loss_weights`; a term without a weight is only logged."""

    loss_weights: dict[str, float]

    def terms(self, batch) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        raise NotImplementedError

    def measure(self, batch: tuple[Tensor, ...]) -> dict[str, Tensor]:
        terms = self.terms(batch)
        weighed = [self.loss_weights.get(name, 0.0) * term for name, term in terms.items()]
        return {"loss": torch.stack(weighed).sum(), **terms}
