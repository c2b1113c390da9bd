"""What all systems do alike: an optimiser that is given, and a step that logs what it measured."""

from collections.abc import Callable
from typing import Any

import lightning
import torch
from torch import Tensor


class SeededSteps(lightning.LightningModule):
    """What a step draws (dropout, augmentation) is a function of seed and step, so that a resumed run repeats it."""

    seed: int

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        torch.manual_seed((self.seed + 1) * 1_000_003 + self.global_step * 64 + self.global_rank)


class GivenOptimizer(lightning.LightningModule):
    """Optimises `net` with the optimiser and, where there is one, the schedule of every step that it was given."""

    _optimizer: Callable[..., torch.optim.Optimizer]
    _scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None

    def configure_optimizers(self):
        optimizer = self._optimizer(self.get_submodule("net").parameters())
        if self._scheduler is None:
            return optimizer
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self._scheduler(optimizer), "interval": "step"},
        }


class Measured(GivenOptimizer):
    """Trains on the "loss" among what `measure` says of a batch, and logs all of it, in training and validation."""

    def measure(self, batch: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """The loss and whatever else is worth a curve."""
        raise NotImplementedError

    def pipeline_parts(self) -> dict[str, Any]:
        """What a pipeline around this network is made with, beside its own settings."""
        raise NotImplementedError

    def _step(self, batch: tuple[Tensor, ...], stage: str) -> Tensor:
        measured = self.measure(batch)
        self.log_dict(
            {f"{stage}/{name}": value for name, value in measured.items()},
            batch_size=len(batch[0]), prog_bar=stage == "train", sync_dist=stage == "val",
            on_step=stage == "train", on_epoch=stage == "val",
        )  # fmt: skip
        return measured["loss"]

    def training_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> Tensor:
        return self._step(batch, "train")

    def validation_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> None:
        self._step(batch, "val")


class WeighedTerms(Measured):
    """The loss is the sum of `terms` by their weights; a term without one is only logged."""

    loss_weights: dict[str, float]

    def terms(self, batch) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        raise NotImplementedError

    def measure(self, batch: tuple[Tensor, ...]) -> dict[str, Tensor]:
        terms = self.terms(batch)
        weighed = [self.loss_weights.get(name, 0.0) * term for name, term in terms.items()]
        return {"loss": torch.stack(weighed).sum(), **terms}
