"""Training of the contact networks: binary cross-entropy of hand contact from poses (thesis §5.3.2)."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.data.windows import Windows, drawn_batches
from wearcap.geometry import rotation
from wearcap.metrics.detection import mean_detection_scores
from wearcap.systems.ireplica.contact_prediction import REACH, ContactNetwork
from wearcap.systems.ireplica.features import PoseFeatures
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.training_windows import ContactWindow
from wearcap.training.base import Optimization, Training


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
