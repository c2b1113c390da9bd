"""Mean and scale of features over a training split, saved with the weights."""

from typing import TypeVar

import torch

W = TypeVar("W", bound=tuple)

MIN_SCALE = 0.05
"""Smallest standard deviation that features are divided by: rotations that hardly vary would become mostly noise."""


def collate(windows: list[W]) -> W:
    """Stacks windows (named tuples of tensors) along a leading batch axis."""
    return type(windows[0])(*(torch.stack(field) for field in zip(*windows)))
