"""Training of the object encoder: classification, size regression and instance discrimination from its feature."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional as F

from wearcap.models.point_encoder import ObjectNetwork, bounds, to_unit_sphere
from wearcap.systems.echo.object_clouds import ObjectCloudDataset, ObjectViews
from wearcap.training.base import WeighedTerms

_TEMPERATURE = 0.1


class ObjectEncoding(WeighedTerms):
    """Trains the feature to predict the category and the half extents, and to match two views of the same object."""

    def __init__(
        self,
        net: ObjectNetwork,
        loss_weights: dict[str, float],
        optimizer: Callable[..., torch.optim.Optimizer],
        scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None,
    ):
        """`loss_weights` of the terms "category", "extents" and "instance"."""
        super().__init__()
        self.net, self.loss_weights = net, loss_weights
        self._optimizer, self._scheduler = optimizer, scheduler

    def set_statistics(self, dataset: ObjectCloudDataset) -> None:
        """Nothing to set: each cloud is normalised by itself, and batch norm keeps its own statistics."""

    def terms(self, batch: ObjectViews) -> dict[str, Tensor]:
        """Loss terms, and the classification accuracy on each view ("accuracy_1", "accuracy_2")."""
        clouds, views = batch.points.flatten(0, 1), batch.points.shape[1]
        feature = self.net.encoder(clouds)
        logits, labels = self.net.category(feature), batch.label.repeat_interleave(views)
        _, radius = to_unit_sphere(clouds)
        extents = bounds(clouds)[0] / radius[:, None]
        accuracy = (logits.argmax(-1) == labels).float().unflatten(0, (-1, views)).mean(0)
        embedding = self.net.instance(feature).unflatten(0, (-1, views))
        return {
            "category": F.cross_entropy(logits, labels),
            "extents": F.l1_loss(self.net.extents(feature), extents),
            "instance": instance_loss(embedding[:, 0], embedding[:, 1]),
            **{f"accuracy_{view + 1}": share for view, share in enumerate(accuracy)},
        }


def instance_loss(
    one: Float[Tensor, "batch feature"], other: Float[Tensor, "batch feature"], temperature: float = _TEMPERATURE
) -> Float[Tensor, ""]:
    """Symmetric InfoNCE loss between two views of each object (van den Oord et al. 2018)."""
    similarity = F.normalize(one, dim=-1) @ F.normalize(other, dim=-1).T / temperature
    target: Int64[Tensor, "batch"] = torch.arange(len(one), device=one.device)
    return (F.cross_entropy(similarity, target) + F.cross_entropy(similarity.T, target)) / 2
