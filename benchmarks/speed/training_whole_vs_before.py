"""Trainings with windows drawn in batches against the same trainings with windows drawn one by one, to equal validation.

Both begin with the same weights and statistics, train for the same number of steps with their schedule, and are validated
on the same windows. Nobody else does a wearer's motion (`data.dataset.bodies`): one by one, opening recordings for each
person takes longer than the training. Before: one by one, in the training's own process, with `BEFORE`'s settings. `…_EXPERIMENT`: seconds of
training, without validations, until the validation loss that the training before has at its end; ratio = baseline / value,
to be at least `goal`, and no more than a bound where the unit names it. `…_step`, `…_drawing`, `…_together`: milliseconds of
a step on a batch that is there, of drawing one, of a step of the training. `…_opening`: seconds until the data set is there,
not part of the above; one by one, recordings are opened as they are drawn. `…_waiting`: share of the training's time that
waits for batches.
"""

import statistics
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from omegaconf import DictConfig, OmegaConf

from benchmarks.speed.figures import figure, seconds
from benchmarks.speed.training_paths import (
    EXPERIMENTS,
    Trained,
    both,
    config_of,
    first_weights,
    has_data,
    samples,
    small_sets,
    threads,
    trained,
)

GOAL = 1.5
BEFORE = {
    "trainer.precision": "32-true",
    "model.compile": False,
    "optimizer.optimizer.fused": False,
    "callbacks.average._target_": "lightning.pytorch.callbacks.EMAWeightAveraging",
}
"""Settings of trainings before, of those that there are."""
PRECISE = {"echo": "bf16-mixed"}
"""Precision of experiments whose precision was another."""


def measure(
    datasets: str | None = "datasets",
    experiments: tuple[str, ...] = EXPERIMENTS,
    steps: int = 600,
    fixed: int = 20,
    cores: int | None = 2,
) -> list[dict]:
    """Of the data sets of a folder, as far as they are there; None: of a small generated one. `fixed`: steps and batches
    of which the parts of a step are measured."""
    figures = []
    with TemporaryDirectory() as folder, threads(cores):
        given = (
            small_sets(Path(folder)) if datasets is None else (f"data.loading.steps_per_epoch={max(1, steps // 12)}",)
        )
        for experiment in experiments:
            more = f"trainer.max_steps={steps}", "++data.dataset.bodies=null"
            config = config_of(experiment, Path(datasets or folder), *given, *more)
            if has_data(config):
                figures += compared(experiment, config, fixed)
    return figures


def compared(experiment: str, config: DictConfig, fixed: int) -> list[dict]:
    """The figures of one experiment."""
    now, before, opened = both(config)
    old = as_before(experiment, config)
    state = first_weights(config, now)
    parts = [_parts(*each, state, fixed) for each in ((config, now), (old, before))]
    ours, theirs = trained(config, now, state), trained(old, before, state)
    target = theirs.clock.validations[-1][1]
    value, baseline = (_reached(each, target) for each in (ours, theirs))
    assert baseline is not None
    unit = "s" if value is not None else "s (not reached: the value is a lower bound)"
    value = value or ours.clock.ends[-1]
    name = f"training_whole_vs_before_{experiment}"
    figures = [figure(name, value, unit, baseline, baseline / value, GOAL)]
    for part, (new, old_ms) in {
        "step": (parts[0][0], parts[1][0]),
        "drawing": (parts[0][1], parts[1][1]),
        "together": (1000 * ours.each_s, 1000 * theirs.each_s),
    }.items():
        figures.append(figure(f"{name}_{part}", new, "ms", old_ms, old_ms / new, None))
    figures.append(figure(f"{name}_opening", opened[0], "s", opened[1], opened[1] / opened[0], None))
    waits = ours.waiting, theirs.waiting
    figures.append(figure(f"{name}_waiting", waits[0], "of the time", waits[1], waits[0] / max(waits[1], 1e-9), None))
    return figures


def as_before(experiment: str, config: DictConfig) -> DictConfig:
    """A training's config with the settings of before."""
    old = config.copy()
    for key, value in (BEFORE | {"trainer.precision": PRECISE.get(experiment, BEFORE["trainer.precision"])}).items():
        if OmegaConf.select(old, key) is not None:
            OmegaConf.update(old, key, value)
    return old


def _parts(config: DictConfig, data: Any, state: dict, fixed: int) -> tuple[float, float]:
    """Milliseconds of a step alone and of drawing a batch alone, medians; recordings are open."""
    windows, size = data.dataset("train"), config.data.loading.batch_size
    drawn = [samples(windows, size, seed) for seed in range(fixed)]
    batches = [windows.batch(*each) for each in drawn]
    drawing = statistics.median(seconds(lambda each=each: windows.batch(*each)) for each in drawn)
    short = config.copy()
    short.trainer.max_steps = fixed
    alone = trained(short, None, state, batches)
    return 1000 * statistics.median(alone.clock.steps), 1000 * drawing


def _reached(training: Trained, target: float) -> float | None:
    """Seconds until a validation loss, linearly between validations; None where it is not reached."""
    last: tuple[float, float] | None = None
    for step, loss in training.clock.validations:
        now = training.clock.ends[step - 1]
        if loss <= target:
            if last is None or last[1] <= loss:
                return now
            return last[0] + (now - last[0]) * (last[1] - target) / (last[1] - loss)
        last = now, loss
    return None
