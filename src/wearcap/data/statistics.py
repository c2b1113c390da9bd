"""Mean and scale of features over a training split, saved with the weights."""

from typing import TypeVar

import torch

W = TypeVar("W", bound=tuple)

MIN_SCALE = 0.05
"""No feature is stretched more than this: rotations that hardly vary would otherwise be mostly noise."""


def collate(windows: list[W]) -> W:
    """Windows, each a tuple of tensors, as one with a leading batch axis."""
    return type(windows[0])(*(torch.stack(field) for field in zip(*windows)))
