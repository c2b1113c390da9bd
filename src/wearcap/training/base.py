"""The base of the LightningModules: seeded steps, optimiser from the config, logged losses."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import lightning
import torch
from torch import Tensor


@dataclass(frozen=True)
class Optimization:
    """How weights are found."""

    optimizer: Callable[..., torch.optim.Optimizer]
    """Called with the trained parameters."""
    scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None
    """Called with the optimiser; it advances every step. None: a constant learning rate."""
    seed: int = 0
    """Seed of dropout and augmentation."""


class Training(lightning.LightningModule):
    """Optimises the "loss" that `measure` returns, and logs all of its values, in training and validation.

    By default the loss is the sum of `terms` times `loss_weights`; a term without a weight is only logged.
    """

    system: ClassVar[type | None] = None
    """The system that captures with the network; None: none does."""
    parts: ClassVar[tuple[str, ...]] = ()
    """Attributes that are constructor arguments of the system's pipeline."""

    def __init__(self, optimization: Optimization, loss_weights: dict[str, float] | None = None):
        super().__init__()
        self.optimization, self.loss_weights = optimization, dict(loss_weights or {})

    def set_statistics(self, dataset: Any) -> None:
        """Compute normalisation from a training split; a resumed run loads it with the weights."""

    def pipeline_parts(self) -> dict[str, Any]:
        """Constructor arguments of the pipeline that belong to the trained model."""
        return {name: getattr(self, name) for name in self.parts}

    def terms(self, batch: Any) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        raise NotImplementedError

    def measure(self, batch: Any) -> dict[str, Tensor]:
        """The "loss" of a batch and further values to log."""
        terms = self.terms(batch)
        weighed = [self.loss_weights.get(name, 0.0) * term for name, term in terms.items()]
        return {"loss": torch.stack(weighed).sum(), **terms}

    def train(self, mode: bool = True) -> "Training":
        """Set the training mode; frozen encoders stay in evaluation mode."""
        super().train(mode)
        for part in self.children():
            trained = [parameter.requires_grad for parameter in part.parameters()]
            if trained and not any(trained):
                part.eval()
        return self

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Make dropout and augmentation of a step a function of seed and step, so that resumed runs repeat it."""
        torch.manual_seed((self.optimization.seed + 1) * 1_000_003 + self.global_step * 64 + self.global_rank)

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

    def configure_optimizers(self):
        optimizer = self.optimization.optimizer([each for each in self.parameters() if each.requires_grad])
        if (scheduler := self.optimization.scheduler) is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler(optimizer), "interval": "step"}}
