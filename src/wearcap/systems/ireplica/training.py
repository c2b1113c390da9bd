"""Training of the contact networks: binary cross-entropy of hand contact from poses (thesis §5.3.2); callbacks of their
validation: temperatures, and the object motion that iReplica captures."""

from collections.abc import Callable
from pathlib import Path

import lightning
import torch
from jaxtyping import Bool, Float
from lightning.pytorch import Callback
from torch import Tensor
from torch.nn import functional as F

from wearcap.data.windows import Windows, drawn_batches
from wearcap.geometry import rotation
from wearcap.io.formats.environment import read_environment
from wearcap.metrics.detection import mean_detection_scores
from wearcap.metrics.objects import summary
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.systems.ireplica.contact_prediction import REACH, ContactDetector, ContactNetwork, ContactPredictor
from wearcap.systems.ireplica.features import PoseFeatures
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.scores import score_interactions
from wearcap.systems.ireplica.training_windows import ContactWindow
from wearcap.training.base import Optimization, Training
from wearcap.training.callbacks import is_due


class ContactDetection(Training):
    """Trains a contact network for some classes of interaction; loss and scores are per frame."""

    system = IReplica

    def __init__(
        self,
        net: Callable[..., ContactNetwork],
        features: PoseFeatures,
        classes: list[str],
        fps: float,
        optimization: Optimization,
    ):
        super().__init__(optimization)
        self.net = net(inputs=features.size, classes=len(classes))
        self.features, self.classes, self.fps = features, tuple(classes), fps
        self._validated: list[tuple[Tensor, Tensor]] = []

    def set_statistics(self, dataset: Windows, limit: int = 400) -> None:
        (batch,) = drawn_batches(dataset, limit)
        self.net.normalize_on(self._pose(batch))

    def _pose(self, batch: ContactWindow) -> Float[Tensor, "batch time feature"]:
        return self.features.encode(batch.R_parent_joint @ rotation.exp(batch.error))

    def measure(self, batch: ContactWindow) -> dict[str, Tensor]:
        """The loss; in validation logits and ground truth of the predicted frames are kept for the scores."""
        logits, truth = self.net(self._pose(batch)), batch.contact[:, REACH:-REACH]
        if not self.training:
            self._validated.append((logits.flatten(0, 1), truth.flatten(0, 1)))
        return {"loss": F.binary_cross_entropy_with_logits(logits, truth.to(logits.dtype))}

    def validated(self) -> tuple[Float[Tensor, "sample hand class"], Bool[Tensor, "sample hand class"]]:
        """Logits and ground truth of the validation epoch so far, from all processes."""
        parts = [torch.cat(part) for part in zip(*self._validated)]
        every = [torch.as_tensor(self.all_gather(part)).reshape(-1, *part.shape[1:]) for part in parts]
        return every[0], every[1]

    def on_validation_epoch_end(self) -> None:
        """Log scores per class, means over hands (thesis Table 5.3); calibration changes no logit's order or sign."""
        logits, truth = self.validated()
        for index, name in enumerate(self.classes):
            scores = mean_detection_scores(logits[..., index].sigmoid(), truth[..., index])
            for metric in ("average_precision", "precision", "recall", "accuracy"):
                self.log(f"val/{name}_{metric}", getattr(scores, metric))
        self._validated.clear()


def fit_temperature(
    logits: Float[Tensor, "sample class"], truth: Bool[Tensor, "sample class"]
) -> Float[Tensor, "class"]:
    """Temperatures (1/5 … 5) with the least cross-entropy, one per class (Guo et al. 2017); 1 where a class never occurs."""
    candidates = torch.linspace(-1.6, 1.6, 161, device=logits.device).exp()
    target = truth.to(logits.dtype)
    losses = torch.stack(
        [F.binary_cross_entropy_with_logits(logits / t, target, reduction="none").mean(0) for t in candidates]
    )
    best = candidates[losses.argmin(0)]
    return torch.where(truth.any(0), best, torch.ones_like(best)).to(logits.dtype)


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
