"""The base of the LightningModules: seeded and compiled steps, optimiser from the config, logged losses."""

import importlib.util
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import require_choice

if TYPE_CHECKING or importlib.util.find_spec("lightning"):
    from lightning import LightningModule
else:  # without the extra `train` modules are built to capture with, and cannot be trained
    LightningModule = torch.nn.Module

WORTH_COMPILING = 1000
"""Steps from which a compiled step saves a CPU more time than its compilation takes, a minute or two."""


def is_logged(trainer: Any, step: int) -> bool:
    """Whether a step is one of those whose values are logged; reading them in others would only make it wait for a GPU."""
    every: int = trainer.log_every_n_steps
    return every > 0 and step % every == 0


def timer_of(trainer: Any) -> Any:
    """The clock (a `Timer`) of a run with `trainer.max_time`, else None."""
    from lightning.pytorch.callbacks import Timer

    return next((each for each in trainer.callbacks if isinstance(each, Timer)), None)


@dataclass(frozen=True)
class Optimization:
    """How weights are found."""

    optimizer: Callable[..., torch.optim.Optimizer]
    """Called with the trained parameters."""
    scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None
    """Called with the optimiser, and under `trainer.max_time` with `elapsed`, a function that gives the share of it that has
    passed; it advances every step. None: a constant learning rate."""
    seed: int = 0
    """Seed of dropout and augmentation."""


class _Compilable(type):
    """Every training has the setting `compile`, which its constructor need not pass on."""

    def __call__(cls, *arguments: Any, compile: bool | str = "auto", **settings: Any) -> Any:
        made = super().__call__(*arguments, **settings)
        made.compiles = compile
        return made


class Training(LightningModule, metaclass=_Compilable):
    """Optimises the "loss" that `measure` returns, and logs all of its values, in training and validation.

    By default the loss is the sum of `terms` times `loss_weights`; a term without a weight is only logged.
    """

    system: ClassVar[type | None] = None
    """The system that captures with the network; None: none does."""
    compiles: bool | str
    """Whether training steps are compiled: True, False or "auto" (`_is_compiled`)."""
    parts: ClassVar[tuple[str, ...]] = ()
    """Attributes that are constructor arguments of the system's pipeline."""

    joint_dof: Tensor | None
    """Degrees of freedom of the joints' errors in the network's own deviations, fitted with these; 0: none was fitted."""

    def __init__(self, optimization: Optimization, loss_weights: dict[str, float] | None = None, spread: bool = False):
        """`spread`: whether the network says how sure it is of each joint."""
        super().__init__()
        self.register_buffer("joint_dof", torch.zeros(()) if spread else None)
        self.optimization, self.loss_weights = optimization, dict(loss_weights or {})

    @property
    def fitted_dof(self) -> float | None:
        """As of a `Motion`."""
        return None if self.joint_dof is None else self.joint_dof.item() or None

    def set_statistics(self, dataset: Any) -> None:
        """Compute normalisation from a training split; a resumed run loads it with the weights."""

    def pipeline_parts(self) -> dict[str, Any]:
        """Constructor arguments of the pipeline that belong to the trained model."""
        return {name: getattr(self, name) for name in self.parts}

    def terms(self, batch: Any) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        raise NotImplementedError

    def away(self, batch: Any) -> Float[Tensor, "row joint axis"] | None:
        """Errors of joints in a batch in the network's own deviations, before these were fitted (`callbacks.FitSpread`); None
        of a network that says none. The logarithms of deviations are the last values of its normalised motion."""
        return None

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

    def on_train_start(self) -> None:
        """Compile `measure` for training steps, where that pays; validation's stays eager."""
        self._measure, mode = self.measure, "reduce-overhead" if self.device.type == "cuda" else None
        if self._is_compiled():  # a function: a compiled module would put every weight into checkpoints a second time
            self._measure = torch.compile(self.measure, dynamic=False, mode=mode)

    def _is_compiled(self) -> bool:
        """Whether training steps are compiled. "auto": on a GPU, and on a CPU with vector instructions for runs of
        `WORTH_COMPILING` steps of networks without dropout, whose random numbers cost compiled code more than it saves."""
        require_choice(str(self.compiles).lower(), ("true", "false", "auto"), f"model.compile={self.compiles!r}")
        dropout = any(isinstance(part, torch.nn.Dropout) and part.p > 0 for part in self.modules())
        vectors = torch.backends.cpu.get_cpu_capability() != "DEFAULT"  # PyTorch compiles for no other CPU
        pays = self.device.type == "cuda" or (self.trainer.max_steps >= WORTH_COMPILING and not dropout and vectors)
        if not (pays if self.compiles == "auto" else self.compiles):
            return False
        found = any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "clang++"))
        if not found:
            warnings.warn("no C++ compiler (g++, clang++ or $CXX): training steps are not compiled", stacklevel=2)
        return found

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Make dropout and augmentation of a step a function of seed and step, so that resumed runs repeat it."""
        torch.manual_seed((self.optimization.seed + 1) * 1_000_003 + self.global_step * 64 + self.global_rank)

    def training_step(self, batch: tuple[Tensor, ...], batch_idx: int) -> Tensor:
        measured = self._measure(batch)
        if is_logged(self.trainer, self.global_step + 1) or timer_of(self.trainer):  # whose last step is logged, too
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
        more = {"elapsed": partial(self._elapsed, timer)} if (timer := timer_of(self.trainer)) else {}
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler(optimizer, **more), "interval": "step"}}

    def _elapsed(self, timer: Any) -> float:
        """Share of `trainer.max_time` that has passed, with earlier starts of the run: the same in all processes."""
        passed = timer.time_elapsed()
        return self.trainer.strategy.broadcast(passed / max(passed + (timer.time_remaining() or 0.0), 1e-9))
