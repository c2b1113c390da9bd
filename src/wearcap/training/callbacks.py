"""Callbacks, which observe a training run and do not change it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import lightning
import torch
from lightning.pytorch import Callback

from wearcap.metrics.scores import score
from wearcap.metrics.table import aggregate
from wearcap.recording import Motion, RecordingStore
from wearcap.runtime.system import System
from wearcap.training.base import Training


def is_due(trainer: lightning.Trainer, every_n_epochs: int) -> bool:
    """Whether a callback that runs at every n-th and at the last validation is due now, in this process."""
    last = trainer.max_steps > 0 and trainer.global_step >= trainer.max_steps
    due = last or (trainer.current_epoch + 1) % every_n_epochs == 0
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
    ):
        """`pipeline` is called with the module's `pipeline_parts`; `draw` writes an image of labelled motions."""
        self.pipeline, self.folder = pipeline, Path(folder)
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
        recordings = []
        for recording in map(store.load, chosen):
            head, motion, contacts = recording.head, recording.motion, recording.contacts
            assert head is not None
            assert motion is not None
            stop = int(torch.searchsorted(head.timestamps, head.timestamps[0] + self.max_seconds))
            streams = "timestamps", "R_world_device", "t_world_device"
            head = replace(head, **{name: getattr(head, name)[:stop] for name in streams})
            if contacts is not None:
                contacts = replace(contacts, timestamps=contacts.timestamps[:stop], contact=contacts.contact[:stop])
            recordings.append(replace(recording, head=head, motion=motion.sliced(0, stop), contacts=contacts))
        motions = [captured.motion for captured in pipeline.capture(recordings, [0] * len(recordings))]
        rows = [score(m, r, r.name, 0) for m, r in zip(motions, recordings)]
        for key, summary in aggregate(rows).items():
            pl_module.log(f"capture/{key}", summary.mean, rank_zero_only=True)
        pl_module.get_submodule("net").train()
        if self.draw is not None:
            path = self.folder / f"step_{trainer.global_step:06d}_{recordings[0].name}.png"
            self.draw(path, {"truth": recordings[0].motion, "capture": motions[0]})
