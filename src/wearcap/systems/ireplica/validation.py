"""Callbacks of the training of contact detectors: their calibration, and the tracking of objects that they allow."""

from collections.abc import Callable
from pathlib import Path

import lightning
import torch
from lightning.pytorch import Callback

from wearcap.io.formats.environment import read_environment
from wearcap.metrics.objects import summary
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.systems.ireplica.contact_prediction import ContactDetector, ContactPredictor
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.scores import score_interactions
from wearcap.systems.ireplica.training import ContactDetection, fit_temperature
from wearcap.training.callbacks import is_due


class FitTemperature(Callback):
    """Fits the network's temperatures after every validation epoch; the checkpoint stores them with the weights.

    It must come before the weight averaging in the list of callbacks: the temperatures belong to the averaged weights.
    """

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: ContactDetection) -> None:
        logits, truth = pl_module.validated()
        pl_module.net.temperature.copy_(fit_temperature(logits.flatten(0, 1), truth.flatten(0, 1)))


class IReplicaValidation(Callback):
    """Tracks objects in recordings of the validation split every n-th validation epoch; logs Tables 5.1 and 5.2.

    HPS is not trained, so its motions are computed once. The callback must come before the weight averaging in the list
    of callbacks, to see the averaged weights. Recordings without the inputs of HPS, or without true objects and
    interactions, are skipped; if none remains, nothing is logged.
    """

    def __init__(self, pipeline: Callable[..., IReplica], recordings: int = 2, every_n_epochs: int = 10):
        """`pipeline` builds iReplica for a `predictor`."""
        self.pipeline, self.recordings, self.every_n_epochs = pipeline, recordings, every_n_epochs
        self._registered: list[tuple[Recording, CaptureInput, Motion]] | None = None
        """The first recordings of the validation split, registered by HPS."""

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: ContactDetection) -> None:
        if not is_due(trainer, self.every_n_epochs):
            return
        training = pl_module.training
        detector = ContactDetector(pl_module.net, pl_module.features, pl_module.classes, pl_module.fps)
        pipeline = self.pipeline(predictor=ContactPredictor(detector))
        with torch.no_grad():
            store = RecordingStore.open(trainer.datamodule.val_sources[0].root)  # pyright: ignore[reportAttributeAccessIssue]
            if self._registered is None:
                self._registered = []
                for name in store.names("val"):
                    if len(self._registered) == self.recordings:
                        break
                    recording = store.load(name)
                    if fit(recording, store.root):
                        source = CaptureInput.in_dataset(recording, store.root)
                        self._registered.append((recording, source, pipeline.registered(source)))
            rows = []
            for recording, source, motion in self._registered:
                environment = read_environment(pipeline.environment_file(source))
                assert recording.suit is not None
                placed = pipeline.placed(environment, source)
                captured = pipeline.interact(motion, pipeline.contacts(recording), placed)
                rows += score_interactions(captured, recording, environment).handlings
        pl_module.train(training)
        for name, value in summary(rows).items() if rows else ():
            pl_module.log(f"ireplica/{name}", value, rank_zero_only=True)


def fit(recording: Recording, folder: Path) -> bool:
    """Whether a recording has the tracker's inputs and the ground truth of its scores."""
    files = recording.environment, recording.scene
    sensed = recording.suit, recording.camera, recording.localization
    true = recording.motion, recording.interactions
    complete = None not in sensed and None not in true and bool(recording.object_motion)
    return complete and all(name is not None and (folder / name).is_file() for name in files)
