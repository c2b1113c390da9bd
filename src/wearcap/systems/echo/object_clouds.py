"""Objects as point clouds: augmented views of generated instances, for training the object encoder."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import safetensors
import torch
from jaxtyping import Float, Int64
from safetensors.torch import load_file, save
from torch import Tensor
from torch.utils.data import Dataset

from wearcap.data.datamodule import SeededWindows
from wearcap.data.surface_points import POINTS
from wearcap.files import atomic_path
from wearcap.geometry import rotation

_KEY = "made_of"


class ObjectViews(NamedTuple):
    """Augmented views of one object's point cloud (m), or a batch of objects (a leading "batch" axis)."""

    points: Float[Tensor, "*batch view point 3"]
    label: Int64[Tensor, "*batch"]


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

    def __call__(self, points: Float[Tensor, "point 3"], random: torch.Generator) -> Float[Tensor, "point 3"]:
        """An augmented cloud (m); all randomness comes from the generator."""
        points = points * (1 + self.stretch * (2 * torch.rand(3, generator=random) - 1))
        points = points + self.jitter_m * torch.randn(points.shape, generator=random)
        any_way, angle, share = torch.rand(3, generator=random).tolist()
        about_up = rotation.about_axis("z", torch.tensor(2 * torch.pi * angle))
        points = points @ (random_rotation(random) if any_way < self.turned else about_up).T
        kept = max(1, int((self.least_kept + (1 - self.least_kept) * share) * len(points)))
        order = torch.randperm(len(points), generator=random)
        repeats = torch.randint(kept, (len(points) - kept,), generator=random)
        return points[order[torch.cat([torch.arange(kept), repeats])]]


def random_rotation(random: torch.Generator) -> Float[Tensor, "3 3"]:
    """A uniformly random rotation: Q of a Gaussian matrix's QR decomposition, made right-handed."""
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=random))
    R = q * r.diagonal().sign()
    return R * R.det().sign()


class ObjectCloudDataset(Dataset):
    """Two views of each generated object: both augmented in training, else one original and one augmented.

    An item's index is (object, seed), or the object alone.
    """

    def __init__(
        self,
        clouds: Float[Tensor, "object point 3"],
        labels: Int64[Tensor, "object"],
        augmentation: CloudAugmentation,
        as_it_is: bool,
    ):
        self.clouds, self.labels = clouds, labels
        self.augmentation, self.as_it_is = augmentation, as_it_is
        self.weights = torch.ones(len(labels))

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, item: tuple[int, int] | int) -> ObjectViews:
        index, seed = item if isinstance(item, tuple) else (item, item)
        random, cloud = torch.Generator().manual_seed(seed), self.clouds[index]
        first = cloud if self.as_it_is else self.augmentation(cloud, random)
        return ObjectViews(torch.stack([first, self.augmentation(cloud, random)]), self.labels[index])


class ObjectClouds(SeededWindows):
    """Generated objects of a simulated household, for the object encoder."""

    def __init__(
        self,
        root: str,
        generate: Callable[[str, Sequence[str], int, int], tuple[Tensor, Tensor]],
        classes: Sequence[str],
        per_class: int,
        val_per_class: int,
        batch_size: int,
        steps_per_epoch: int,
        points: int = POINTS,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        augmentation: CloudAugmentation | None = None,
    ):
        """`per_class` objects per class for training and `val_per_class` others for validation, cached in `root`.

        `generate` creates missing clouds from a split, classes, a number of objects per class and a number of points:
        clouds "object point 3" (m) and class indices "object". A batch has `batch_size` objects with two views each.
        """
        super().__init__({}, batch_size, steps_per_epoch, val_windows, workers, seed, None)
        self.root, self.generate, self.classes, self.points = Path(root), generate, tuple(classes), points
        self.counts = {"train": per_class, "val": val_per_class}
        self.augmentation = augmentation or CloudAugmentation()

    def dataset(self, split: str) -> ObjectCloudDataset:
        """Objects of a split, generated if their file is missing or was made with other settings."""
        clouds, labels = cached_clouds(self.root, self.generate, split, self.classes, self.counts[split], self.points)
        return ObjectCloudDataset(clouds, labels, self.augmentation, as_it_is=split != "train")


def cached_clouds(
    root: Path,
    generate: Callable[[str, Sequence[str], int, int], tuple[Tensor, Tensor]],
    split: str,
    classes: Sequence[str],
    per_class: int,
    points: int,
) -> tuple[Float[Tensor, "object point 3"], Int64[Tensor, "object"]]:
    """Clouds (m, in their objects' own axes) and class indices from a file in `root`, which is created if needed."""
    path, made_of = root / f"{split}.safetensors", json.dumps([list(classes), per_class, points])
    if _made_of(path) != made_of:
        clouds, labels = generate(split, classes, per_class, points)
        with atomic_path(path) as temporary:
            temporary.write_bytes(save({"clouds": clouds, "labels": labels}, {_KEY: made_of}))
    tensors = load_file(path)
    return tensors["clouds"], tensors["labels"]


def _made_of(path: Path) -> str | None:
    try:
        with safetensors.safe_open(str(path), framework="pt") as file:
            return (file.metadata() or {}).get(_KEY)
    except (safetensors.SafetensorError, OSError):
        return None
