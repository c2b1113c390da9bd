"""Training of the object encoder on augmented views of generated objects: category, size, and identity from its feature."""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from einops import rearrange, reduce, repeat
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional as F

from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.data.draws import Draws
from wearcap.data.objects import POINTS
from wearcap.data.windows import Source
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.models.point_encoder import ObjectNetwork, bounds, to_unit_sphere
from wearcap.training.base import Optimization, Training

_KEY = "made_of"
_TEMPERATURE = 0.1


class _ObjectViews(NamedTuple):
    """Augmented views of the point clouds (m) of a batch of objects."""

    points: Float[Tensor, "batch view point 3"]
    label: Int64[Tensor, "batch"]


@dataclass(frozen=True)
class CloudAugmentation:
    """Augmentation of a cloud: anisotropic scaling along the object's axes, jitter, rotation, and dropped points."""

    stretch: float = 0.1
    """Largest deviation of each axis's scale factor from 1."""
    jitter_m: float = 0.002
    """Standard deviation of the noise on each coordinate (m)."""
    least_kept: float = 0.5
    """Smallest share of points that are kept; dropped points are replaced by duplicates of kept ones."""
    turned: float = 0.5
    """Share of views with a uniformly random rotation; the others are rotated about the vertical axis."""

    def __call__(
        self, points: Float[Tensor, "batch point 3"], draws: Draws, view: str
    ) -> Float[Tensor, "batch point 3"]:
        """Augmented clouds (m); all randomness comes from the draws of a view."""
        batch, count, _ = points.shape
        points = points * (1 + self.stretch * (2 * draws.uniform(f"{view} stretch", 1, 3) - 1))
        points = points + self.jitter_m * draws.normal(f"{view} jitter", count, 3)
        any_way, angle, share = draws.uniform(f"{view} turn", 3).unbind(1)
        about_up = rotation.about_axis("z", 2 * torch.pi * angle)
        anyhow = rotation.matrix_from_quat_wxyz(draws.normal(f"{view} rotation", 4))  # uniform over all rotations
        points = points @ torch.where((any_way < self.turned)[:, None, None], anyhow, about_up).mT
        kept = ((self.least_kept + (1 - self.least_kept) * share) * count).long().clamp_min(1)[:, None]
        order = draws.uniform(f"{view} order", count).argsort(1)
        repeats = (draws.uniform(f"{view} repeats", count) * kept).long()
        place = torch.arange(count, device=points.device).expand(batch, -1)
        chosen = order.gather(1, torch.where(place < kept, place, repeats))
        return points.gather(1, chosen[..., None].expand(-1, -1, 3))


class ObjectClouds:
    """Two views of each generated object: both augmented in training, else one original and one augmented."""

    def __init__(
        self,
        sources: Sequence[Source],
        split: str,
        augmented: bool = False,
        *,
        root: str,
        generate: Callable[[str, Sequence[str], int, int], tuple[Tensor, Tensor]],
        classes: Sequence[str],
        per_class: dict[str, int],
        points: int = POINTS,
        augmentation: CloudAugmentation | None = None,
    ):
        """`per_class` objects per class for each split ("train", "val"), cached in `root`; there are no `sources`.

        `generate` creates clouds that are missing, or were made with other settings, from a split, classes, a number of
        objects per class and a number of points: clouds "object point 3" (m) and class indices "object".
        """
        count, path = per_class[split], Path(root) / f"{split}.safetensors"
        made_of = json.dumps([list(classes), count, points])
        metadata, tensors = dict[str, str](), dict[str, Tensor]()
        with suppress(WearcapError):  # none yet, or damaged
            metadata, tensors = read_tensors(path, "file of clouds")
        if metadata.get(_KEY) != made_of:
            tensors = dict(zip(("clouds", "labels"), generate(split, tuple(classes), count, points)))
            write_tensors(path, tensors, {_KEY: made_of})
        self.clouds: Float[Tensor, "object point 3"] = tensors["clouds"]
        self.labels: Int64[Tensor, "object"] = tensors["labels"]
        self.augmentation, self.augmented = augmentation or CloudAugmentation(), augmented
        self.weights = torch.ones(len(self.labels))

    def __len__(self) -> int:
        return len(self.labels)

    def batch(self, index: Int64[Tensor, "batch"], seed: Int64[Tensor, "batch"]) -> _ObjectViews:
        """Objects by their numbers, each augmented by its seed."""
        draws, clouds = Draws(seed), self.clouds[index]
        first = self.augmentation(clouds, draws, "first") if self.augmented else clouds
        return _ObjectViews(torch.stack([first, self.augmentation(clouds, draws, "second")], 1), self.labels[index])


class ObjectEncoding(Training):
    """Trains the feature to predict the category and the half extents, and to match two views of the same object.

    Each cloud is normalised by itself, and batch norm keeps its own statistics: none are set before.
    """

    def __init__(self, net: ObjectNetwork, loss_weights: dict[str, float], optimization: Optimization):
        """`loss_weights` of the terms "category", "extents" and "instance"."""
        super().__init__(optimization, loss_weights)
        self.net = net

    def terms(self, batch: _ObjectViews) -> dict[str, Tensor]:
        """Loss terms, and the classification accuracy on each view ("accuracy_1", "accuracy_2")."""
        clouds, views = rearrange(batch.points, "batch view point xyz -> (batch view) point xyz"), batch.points.shape[1]
        feature = self.net.encoder(clouds)
        logits, labels = self.net.category(feature), repeat(batch.label, "batch -> (batch view)", view=views)
        _, radius = to_unit_sphere(clouds)
        extents = bounds(clouds)[0] / radius[:, None]
        accuracy = reduce((logits.argmax(-1) == labels).float(), "(batch view) -> view", "mean", view=views)
        embedding = rearrange(self.net.instance(feature), "(batch view) value -> batch view value", view=views)
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
