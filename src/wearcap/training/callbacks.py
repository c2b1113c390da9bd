"""Callbacks, which observe a training run and do not change it."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch import Callback
from lightning.pytorch.callbacks import RichProgressBar, WeightAveraging
from rich.progress import TaskID

from wearcap.metrics.certainty import tails
from wearcap.metrics.table import aggregate
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.timing import first_seconds
from wearcap.runtime.system import CaptureInput, Refine, System
from wearcap.training.base import Training, is_logged, timer_of


def is_due(trainer: lightning.Trainer, every_n_epochs: int) -> bool:
    """Whether a callback that runs at every n-th and at the last validation is due now, in this process."""
    last = trainer.max_steps > 0 and trainer.global_step >= trainer.max_steps
    due = last or trainer.should_stop or (trainer.current_epoch + 1) % every_n_epochs == 0
    return due and trainer.is_global_zero and not trainer.sanity_checking


class CaptureValidation(Callback):
    """Captures some validation recordings with the current weights; logs metrics and draws them beside ground truth.

    It must come before the weight averaging in the list of callbacks, so that it uses the averaged weights.
    """

    def __init__(
        self,
        pipeline: Callable[..., System],
        folder: str,
        recordings: int = 4,
        max_seconds: float = 20.0,
        every_n_epochs: int = 5,
        draw: Callable[[Path, dict[str, Motion]], None] | None = None,
        refine: Refine | None = None,
    ):
        """`pipeline` is called with the module's `pipeline_parts`; `draw` writes an image of labelled motions. The
        captures' metrics after `refine` are logged beside those before it."""
        self.pipeline, self.folder, self.refine = pipeline, Path(folder), refine
        self.recordings, self.max_seconds, self.every_n_epochs = recordings, max_seconds, every_n_epochs
        self.draw = draw

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: Training) -> None:
        if not is_due(trainer, self.every_n_epochs):
            return
        pipeline = self.pipeline(**pl_module.pipeline_parts(), device=str(pl_module.device))
        store = RecordingStore.open(trainer.datamodule.val_sources[0].root)  # pyright: ignore[reportAttributeAccessIssue]
        # Some, evenly chosen, and their first seconds only: this does not replace an evaluation.
        names = store.names("val")
        chosen = names[:: max(1, len(names) // self.recordings)][: self.recordings]
        recordings = [first_seconds(recording, self.max_seconds) for recording in map(store.load, chosen)]
        sources = [CaptureInput.in_dataset(recording, store.root) for recording in recordings]
        # Lightning validates in inference mode, whose tensors a pipeline's own gradient steps cannot use.
        with torch.inference_mode(False), torch.no_grad():
            motions = {"capture": [captured.motion for captured in pipeline.capture(sources, [0] * len(sources))]}
            if self.refine is not None:
                pairs = zip(motions["capture"], sources)
                motions["refined"] = [motion and self.refine(motion, source).motion for motion, source in pairs]
            scores = {
                step: aggregate([pipeline.score(motion, source, 0) for motion, source in zip(found, sources) if motion])
                for step, found in motions.items()
            }
        for step, summaries in scores.items():
            for key, summary in summaries.items():
                pl_module.log(f"{step}/{key}", summary.mean, rank_zero_only=True)
        pl_module.get_submodule("net").train()
        if self.draw is not None:
            path = self.folder / f"step_{trainer.global_step:06d}_{recordings[0].name}.png"
            self.draw(path, {"truth": recordings[0].motion} | {step: found[0] for step, found in motions.items()})


class MovingAverage(WeightAveraging):
    """An exponential moving average of the weights, which a step updates in one operation without waiting for a GPU.

    Lightning's own stays on the CPU when the weights go to a GPU, and asks the GPU in each step whether it is the first.
    """

    state_key = "EMAWeightAveraging"  # pyright: ignore[reportAssignmentType]  # as in checkpoints with Lightning's

    def __init__(self, decay: float, use_buffers: bool = False):
        """`decay`: share of the average that a step keeps. Buffers are copied, or averaged, too (`use_buffers`)."""
        super().__init__(use_buffers=use_buffers)
        self.decay = decay

    def setup(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)

    @torch.no_grad()
    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module, outputs, batch, batch_idx: int) -> None:
        if trainer.global_step == self._latest_update_step or self._average_model is None:
            return
        share = 1 - self.decay if self._latest_update_step else 1.0
        self._latest_update_step, average = trainer.global_step, self._average_model.module
        torch._foreach_lerp_([*average.parameters()], [*pl_module.parameters()], share)
        for old, new in zip(average.buffers(), pl_module.buffers()):
            old.lerp_(new, share) if self._use_buffers and old.is_floating_point() else old.copy_(new)
        self._average_model.n_averaged += 1


def steps_of_run(trainer: lightning.Trainer) -> float:
    """The run's steps: `max_steps`, or those of `max_epochs` (infinite without either)."""
    if trainer.max_steps > 0:
        return trainer.max_steps
    epochs = trainer.max_epochs
    per_epoch = math.ceil(trainer.num_training_batches / trainer.accumulate_grad_batches)
    return epochs * per_epoch if epochs is not None and epochs > 0 else math.inf


class Speed(Callback):
    """Shows windows per second, the share of time that steps wait for them and minutes to the end of the run; logs them at every
    validation (`speed/…`), of the steps since the one before but for the first.

    A wait is from a step's end to the next one's batch, in a GPU's own time, which is read when the GPU has come past it.
    """

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self._start = time.perf_counter(), trainer.global_step
        self.on_validation_end(trainer, pl_module)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self._waits: list[tuple[Any, Any]] = []
        self._steps: list[tuple[float, int]] = []  # when they ended, and their windows

    def on_train_batch_start(self, trainer: lightning.Trainer, pl_module, batch, batch_idx: int) -> None:
        if self._steps:
            self._waits.append((self._ended, _mark(pl_module.device)))

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module, outputs, batch, batch_idx: int) -> None:
        self._steps.append((time.perf_counter(), len(batch[0]) * trainer.world_size))
        self._ended = _mark(pl_module.device)
        if is_logged(trainer, trainer.global_step) and len(self._steps) > 1:
            pl_module.log_dict(self._values(trainer), prog_bar=True, logger=False)

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if len(self._steps) > 1:
            values = {f"speed/{name}": value for name, value in self._values(trainer).items()}
            pl_module.log_dict(values, rank_zero_only=True)

    def _values(self, trainer: lightning.Trainer) -> dict[str, float]:
        seconds, pace = self._steps[-1][0] - self._steps[0][0], time.perf_counter() - self._start[0]
        left = pace / (trainer.global_step - self._start[1]) * (steps_of_run(trainer) - trainer.global_step)
        if (timer := timer_of(trainer)) is not None:
            left = min(left, timer.time_remaining() or 0.0)
        values = {
            "windows_per_s": sum(windows for _, windows in self._steps[1:]) / seconds,
            "waiting": sum(_seconds(*wait) for wait in self._waits) / seconds,
            "minutes_left": max(0.0, left / 60),
        }
        return {name: value for name, value in values.items() if math.isfinite(value)}


def _mark(device: torch.device) -> Any:
    """A point in time: an event in a GPU's queue, or this process's clock (s)."""
    if device.type != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def _seconds(start: Any, end: Any) -> float:
    """Seconds between two marks; 0 until a GPU has come past them."""
    if isinstance(end, float):
        return end - start
    return start.elapsed_time(end) / 1000 if end.query() else 0.0


class StepsProgressBar(RichProgressBar):
    """Progress in steps out of all that the run will make, in place of an epoch's batches."""

    @property
    def total_train_batches(self) -> int | float:
        """The run's steps."""
        return steps_of_run(self.trainer)

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin the bar in the first epoch; in later ones only their number changes."""
        if self.train_progress_bar_id is None:
            super().on_train_epoch_start(trainer, pl_module)
            self._update(self.train_progress_bar_id, trainer.global_step)
        elif self.progress is not None:
            self.progress.update(
                self.train_progress_bar_id, description=self._get_train_description(trainer.current_epoch)
            )

    def _update(self, progress_bar_id: TaskID | None, current: int, visible: bool = True, hard: bool = False) -> None:
        steps = self.trainer.global_step if progress_bar_id == self.train_progress_bar_id else current
        super()._update(progress_bar_id, steps, visible, hard)

    def _update_metrics(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Show metrics when they are logged."""
        if is_logged(trainer, trainer.global_step):
            super()._update_metrics(trainer, pl_module)

    def _get_train_description(self, current_epoch: int) -> str:
        return f"epoch {current_epoch}, steps"


LEAST_FACTOR = 0.1


class FitSpread(Callback):
    """Scales the joints' deviations after every validation epoch, so that 68 % of each joint's errors are within them, and fits
    the errors' degrees of freedom; the checkpoint stores the logarithms of the factors as the deviations' mean.

    It must come before the weight averaging in the list of callbacks: the factors belong to the averaged weights.
    """

    @torch.no_grad()
    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        module: Any = pl_module
        found = []
        for batch in trainer.val_dataloaders or ():
            away = module.away(module.transfer_batch_to_device(batch, module.device, 0))
            if away is None:
                return
            found.append(away.movedim(1, 0).flatten(1))
        if found:
            away = torch.cat(found, 1)
            factor = away.quantile(0.6827, dim=1).clamp_min(LEAST_FACTOR)
            module.net.motion_normalizer.mean[-len(factor) :] = factor.log()
            predicted = factor > LEAST_FACTOR  # not the head, which is measured
            module.joint_dof.fill_(tails(away[predicted] / factor[predicted, None])[1] or 0.0)
