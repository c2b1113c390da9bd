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

    def training_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> Tensor:
        measured = self.measure(batch)
        if (self.global_step + 1) % max(1, self.trainer.log_every_n_steps) == 0:
            values = {f"train/{name}": value.detach().clone() for name, value in measured.items()}
            self.log_dict(values, batch_size=len(batch[0]), prog_bar=True)
        return measured["loss"]

    def validation_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> None:
        values = {f"val/{name}": value for name, value in self.measure(batch).items()}
        self.log_dict(values, batch_size=len(batch[0]), sync_dist=True)

    def configure_optimizers(self):
        optimizer = self.optimization.optimizer([each for each in self.parameters() if each.requires_grad])
        # Lightning unscales gradients before it clips them, and refuses optimisers that would do so once more.
        optimizer._step_supports_amp_scaling = False  # pyright: ignore[reportAttributeAccessIssue]
        if (scheduler := self.optimization.scheduler) is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler(optimizer), "interval": "step"}}
