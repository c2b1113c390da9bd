"""Mean and scale of features over a training split, saved with the weights."""

from typing import TypeVar

import torch
from torch import Tensor

from wearcap.data.features import HeadFeatures
from wearcap.data.windows import WindowDataset

W = TypeVar("W", bound=tuple)

MIN_SCALE = 0.05
"""No feature is stretched more than this: rotations that hardly vary would otherwise be mostly noise."""


def collate(windows: list[W]) -> W:
    """Windows, each a tuple of tensors, as one with a leading batch axis."""
    return type(windows[0])(*(torch.stack(field) for field in zip(*windows)))


def feature_statistics(
    dataset: WindowDataset, features: HeadFeatures, limit: int = 2000
) -> dict[str, tuple[Tensor, Tensor]]:
    """(mean, scale) of "motion", "head", "points" and "image" over at most `limit` windows, drawn by the dataset's weights."""
    random = torch.Generator().manual_seed(0)
    count = min(limit, 4 * len(dataset))
    windows = torch.multinomial(dataset.weights, count, replacement=True, generator=random).tolist()
    sums: dict[str, list[Tensor]] = {}
    for start in range(0, count, 64):
        batch = collate(
            [dataset[item] for item in zip(windows[start : start + 64], range(start, start + 64))]
        )
        motion = features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
        head = features.condition(
            batch.R_world_head, batch.t_world_head, batch.floor_height, batch.size, dataset.fps
        )
        for name, value, valid in (
            ("motion", motion, batch.valid),
            ("head", head, batch.valid),
            ("points", batch.points, batch.valid & batch.points_valid),
            ("image", batch.image, batch.valid & batch.image_valid),
        ):
            rows = value[valid].double()
            moments = torch.stack([torch.ones_like(rows).sum(0), rows.sum(0), rows.square().sum(0)])
            sums.setdefault(name, []).append(moments)
    result = {}
    for name, parts in sums.items():
        number, total, squares = torch.stack(parts).sum(0)
        mean = total / number.clamp_min(1)
        scale = (squares / number.clamp_min(1) - mean**2).clamp_min(0).sqrt().clamp_min(MIN_SCALE)
        result[name] = (mean.float(), scale.float())
    return result
