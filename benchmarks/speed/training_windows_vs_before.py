"""Windows drawn in batches against windows drawn one by one, and against other papers' loaders, alone on the CPU.

For each experiment value and baseline are windows per second of a core's time, in batches (`Windows.batch`) and one by one
(`benchmarks/rivals/single_windows`) at the experiment's batch size, by turns on one thread, medians, recordings open on
both sides; ratio = value / baseline, to be at least `goal`. `…_first`: the same windows when they are first drawn; one by
one, this opens their recordings, for each of the people who do a motion.

Loaders (`benchmarks/rivals/window_loaders.py`) are compared with motion_diffusion_head's windows on the same recordings:
value is ours per core and baseline theirs, per process at work (`…_NAME`), or ours with one thread and theirs with as many
processes as are fastest here (`…_NAME_processes_N`). Theirs have no augmentation, no noise and no bodies, which favours them.
"""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from torch.utils.data import DataLoader, Dataset

from benchmarks.rivals.single_windows.compose import data_before
from benchmarks.rivals.window_loaders import Archive, ClipsInMemory, FilePerItem, encoded_clips, loader, raw_clips
from benchmarks.speed.figures import figure
from benchmarks.speed.training_paths import EXPERIMENTS, config_of, data_now, has_data, samples, small_sets, threads
from wearcap.recording import RecordingStore
from wearcap.training.run import keep_freed_memory

GOAL = 20.0
UNIT = "windows/s and core"
LOADED = "motion_diffusion_head"
"""The experiment whose inputs other papers' loaders give."""


def measure(
    datasets: str | None = "datasets",
    experiments: tuple[str, ...] = EXPERIMENTS,
    batches: int = 4,
    rounds: int = 5,
    workers: tuple[int, ...] = (0, 1, 2),
    seconds: float = 5.0,
) -> list[dict]:
    """Of the data sets of a folder, as far as they are there; None: of a small generated one."""
    figures = []
    keep_freed_memory()  # as trainings do
    with TemporaryDirectory() as folder, threads(1):
        given = () if datasets else small_sets(Path(folder))
        for experiment in experiments:
            config = config_of(experiment, Path(datasets or folder), *given)
            if not has_data(config):
                continue
            first, later = drawn_alone(config, batches, rounds)
            figures += [_figure(experiment, *later, GOAL), _figure(f"{experiment}_first", *first, None)]
            if experiment == LOADED:
                figures += against_loaders(config, later[0], workers, seconds, Path(folder))
    return figures


def _figure(name: str, value: float, baseline: float, goal: float | None) -> dict:
    return figure(f"training_windows_vs_before_{name}", value, UNIT, baseline, value / baseline, goal)


def drawn_alone(config: DictConfig, batches: int, rounds: int) -> tuple[tuple[float, ...], ...]:
    """Windows per second of a core's time, in batches and one by one: when they are first drawn, and later."""
    size, sides = config.data.loading.batch_size, []
    made: list[Any] = [data_now(config), data_before(config)]
    for windows in (data.dataset("train") for data in made):
        drawn = [samples(windows, size, seed) for seed in range(batches)]
        sides.append(lambda windows=windows, drawn=drawn: [windows.batch(*each) for each in drawn])
    first, *later = [[_core_seconds(side) for side in sides] for _ in range(rounds + 1)]
    medians = [statistics.median(side) for side in zip(*later)]
    return tuple(tuple(batches * size / spent for spent in times) for times in (first, medians))


def _core_seconds(run: Callable[[], object]) -> float:
    begin = time.process_time()
    run()
    return time.process_time() - begin


def against_loaders(
    config: DictConfig, ours: float, workers: tuple[int, ...], seconds: float, folder: Path
) -> list[dict]:
    """Figures of the loaders of other papers, on a training's recordings and with its windows' length."""
    stores = [RecordingStore.open(source.root) for source in config.data.sources.values() if source]
    window, size = config.data.dataset.window, config.data.loading.batch_size
    encoded = encoded_clips(stores, instantiate(config.features), window)
    sets: dict[str, Dataset] = {
        "clips_in_memory": ClipsInMemory(encoded, window),
        "file_per_item": FilePerItem(encoded, folder, window),
        "archive": Archive(raw_clips(stores, window), folder / "windows.npz", window),
    }
    figures = []
    for name, windows in sets.items():
        rates = {count: _rate(loader(windows, size, count), size, seconds) for count in workers}
        alone = max(rate / max(1, count) for count, rate in rates.items())
        best = max(rates, key=lambda count: rates[count])
        figures.append(_figure(name, ours, alone, None))
        figures.append(_figure(f"{name}_processes_{best}", ours, rates[best], None) | {"unit": "windows/s"})
    return figures


def _rate(made: DataLoader, size: int, seconds: float) -> float:
    """Windows per second of a loader, once it has begun; passes follow each other."""
    count = begin = 0
    while True:
        for _ in made:
            begin, count = begin or time.perf_counter(), count + 1
            if count > 1 and (since := time.perf_counter() - begin) > seconds:
                return (count - 1) * size / since
