"""Trainings whose windows are drawn in batches, and the same trainings with windows drawn one by one, as before."""

import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.utils import instantiate
from jaxtyping import Int64
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.profilers import Profiler
from omegaconf import DictConfig
from torch import Tensor
from torch.utils.data import DataLoader

from benchmarks.rivals.single_windows.compose import data_before, training_config
from benchmarks.speed.figures import seconds
from benchmarks.speed.training_sets import generated, sources_of, write_set
from wearcap.training.base import Training
from wearcap.training.run import affordable_precision, keep_freed_memory

EXPERIMENTS = ("motion_diffusion_head", "hmd2", "mocap_every", "mocap_every_mlp", "echo", "contact_sequence")
_FETCH = "[_TrainingEpochLoop].train_dataloader_next"
"""Lightning's name of waiting for a batch."""


def config_of(experiment: str, datasets: Path, *overrides: str) -> DictConfig:
    """A training's config, with the data sets of a folder."""
    return training_config(experiment, [f"paths.datasets={datasets}", "paths.run=run", *overrides])


def data_now(config: DictConfig) -> Any:
    """The data of a training, drawn as `wearcap train` does."""
    return instantiate(config.data, _convert_="all")


def has_data(config: DictConfig) -> bool:
    """Whether all data sets of a training are there."""
    parts = (config.data.sources, config.data.val_sources)
    roots = [Path(source.root) for part in parts for source in (part or {}).values() if source]
    return all((root / "manifest.json").is_file() for root in roots)


def small_sets(folder: Path) -> tuple[str, ...]:
    """Write a small data set on which `experiment=motion_diffusion_head` trains; returns overrides for small batches."""
    write_set(folder / "simulated", generated(sources_of(None), 100 / 3600, 5.0, 60.0))
    settings = {"batch_size": 8, "val_windows": 8, "steps_per_epoch": 3}
    return tuple(f"data.loading.{name}={value}" for name, value in settings.items())


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """PyTorch computes with so many threads; None: as many as it does."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def samples(windows: Any, count: int, seed: int = 0) -> tuple[Int64[Tensor, "batch"], Int64[Tensor, "batch"]]:
    """Indices drawn by a data set's weights, and seeds of windows."""
    random = torch.Generator().manual_seed(seed)
    index = torch.multinomial(windows.weights, count, replacement=True, generator=random)
    return index, torch.randint(2**62, (count,), generator=random)


class Clock(Callback):
    """What a training takes step by step, and its losses."""

    def __init__(self):
        self.losses: list[Tensor] = []
        self.steps: list[float] = []
        """Seconds of each step, from its batch to the updated weights."""
        self.ends: list[float] = []
        """Seconds of training until each step's end, validations left out."""
        self.validations: list[tuple[int, float]] = []
        """Number of steps, and the validation loss after them."""
        self._begin = self._start = 0.0

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self._begin = time.perf_counter()

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        self._start = time.perf_counter()

    def on_train_batch_end(self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        now = time.perf_counter()
        self.losses.append(outputs["loss"].detach())
        self.steps.append(now - self._start)
        self.ends.append(now - self._begin)

    def on_validation_start(self, trainer: Any, pl_module: Any) -> None:
        self._start = time.perf_counter()

    def on_validation_end(self, trainer: Any, pl_module: Any) -> None:
        self._begin += time.perf_counter() - self._start
        self.validations.append((trainer.global_step, float(trainer.callback_metrics["val/loss"])))


class Waits(Profiler):
    """Seconds of waiting for each batch."""

    def __init__(self):
        super().__init__()
        self.seconds: list[float] = []
        self._begin = 0.0

    def start(self, action_name: str) -> None:
        if action_name == _FETCH:
            self._begin = time.perf_counter()

    def stop(self, action_name: str) -> None:
        if action_name == _FETCH:
            self.seconds.append(time.perf_counter() - self._begin)


@dataclass(frozen=True)
class Trained:
    """A training's measures."""

    clock: Clock
    waited: list[float]
    """Seconds of waiting for each step's batch."""

    @property
    def each_s(self) -> float:
        """Median time (s) from one step's end to the next one's."""
        ends = self.clock.ends
        return statistics.median(b - a for a, b in pairwise(ends))

    @property
    def waiting(self) -> float:
        """Share of the time that waits for batches; the first batch counts for none."""
        return sum(self.waited[1 : len(self.clock.ends)]) / (self.clock.ends[-1] - self.clock.ends[0])


def trained(config: DictConfig, data: Any, state: dict[str, Tensor], batches: Sequence[Any] = ()) -> Trained:
    """Train a config's model from weights with its optimiser, precision and averaging, on drawn data or given batches."""
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    keep_freed_memory()
    module = instantiate(config.model, _convert_="all")
    module.load_state_dict(state)
    clock, waits = Clock(), Waits()
    average = config.callbacks.get("average")
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    trainer = instantiate(
        config.trainer,
        precision=affordable_precision(str(config.trainer.precision), str(config.trainer.accelerator)),
        callbacks=[*([instantiate(average)] if average else []), clock],
        profiler=waits,
        default_root_dir=None,
        **quiet,
    )
    if batches:
        trainer.fit(module, train_dataloaders=fixed(batches))
    else:
        trainer.fit(module, datamodule=data)
    return Trained(clock, waits.seconds)


def first_weights(config: DictConfig, data: Any) -> dict[str, Tensor]:
    """Weights and statistics with which a training begins."""
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    module: Training = instantiate(config.model, _convert_="all")
    module.set_statistics(data.dataset("train"))
    return module.state_dict()


def fixed(batches: Sequence[Any]) -> DataLoader:
    """A loader of batches that there are."""
    return DataLoader(batches, batch_size=None)  # pyright: ignore[reportArgumentType]


def both(config: DictConfig) -> tuple[Any, Any, list[float]]:
    """A config's data drawn in batches and drawn one by one, validated on the same windows; and seconds to open each."""
    now, before = data_now(config), data_before(config)
    opened = [seconds(lambda data=data: data.dataset("train")) for data in (now, before)]
    before.setup("fit")
    validation = fixed([*before.val_dataloader()])
    now.val_dataloader = before.val_dataloader = lambda: validation
    return now, before, opened
