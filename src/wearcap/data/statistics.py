"""Mean and scale of features over a training split, saved with the weights."""

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.models.layers import Normalizer

W = TypeVar("W", bound=tuple)

MIN_SCALE = 0.05
"""Smallest standard deviation that features are divided by: rotations that hardly vary would become mostly noise."""


def collate(windows: Sequence[W]) -> W:
    """Stacks windows (named tuples of tensors) along a leading batch axis."""
    return type(windows[0])(*(torch.stack(field) for field in zip(*windows)))


def drawn_batches(dataset: Any, limit: int, size: int | None = None) -> Iterator[Any]:
    """Batches of `size` (default: one batch) of `limit` windows, drawn by the data set's weights from a fixed seed."""
    random = torch.Generator().manual_seed(0)
    drawn = torch.multinomial(dataset.weights, limit, replacement=True, generator=random).tolist()
    items, size = [*zip(drawn, range(limit))], size or limit
    for first in range(0, limit, size):
        yield collate([dataset[item] for item in items[first : first + size]])


def standardize(normalizer: Normalizer, rows: Float[Tensor, "*batch feature"], min_scale: float = MIN_SCALE) -> None:
    """Set a normaliser to mean and standard deviation over all rows."""
    rows = rows.flatten(0, -2)
    normalizer.set(rows.mean(0), rows.std(0).clamp_min(min_scale))
