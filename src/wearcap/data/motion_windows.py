"""Windows of true motion alone, for the autoencoder that motions are compared with.

The windows of the head-driven networks carry floors and heads as they were sensed; here the body is what it was.
"""

from functools import cache
from pathlib import Path

import torch
from torch.utils.data import Dataset

from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.datamodule import SeededWindows
from wearcap.data.motion_features import MotionFeatures, Movement
from wearcap.data.windows import Source, joint_twins, requested, share_out
from wearcap.recording.store import RecordingFile


class MovementDataset(Dataset):
    """Complete windows of one split of one or more data sets, indexed by (window, seed) or by window alone.

    A recording's joints are computed at its first use and kept: 17 MB per hour at 20 frames a second.
    """

    def __init__(
        self,
        sources: list[Source],
        split: str,
        *,
        features: MotionFeatures,
        window: int,
        stride: int,
        augment: bool = False,
        balance: float = 1.0,
    ):
        """`augment` shifts windows by up to a stride and mirrors half of them; `balance`: see `WindowDataset`."""
        self.features, self.length, self.augment = features, window // features.every, augment
        self.stride = stride
        self.recordings, self.starts, self.weights = share_out(
            sources, split, window=window, stride=stride, fps=features.fps, balance=balance, min_frames=window
        )

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, item: tuple[int, int] | int) -> Movement:
        index, random = requested(item)
        shift, mirrored = torch.rand(2, generator=random).tolist()
        recording, start, _ = self.starts[index].tolist()
        store, name = self.recordings[recording]
        whole = _movement(store.path_of(name), self.features)
        start = start + int(shift * self.stride) if self.augment else start
        first = min(start // self.features.every, len(whole.floor_height) - self.length)
        window = Movement(*(part[first : first + self.length] for part in whole))
        return mirror(window, self.features.skeleton) if self.augment and mirrored < 0.5 else window


@cache
def _movement(path: Path, features: MotionFeatures) -> Movement:
    return features.movement(RecordingFile(path).part("motion"))


def mirror(movement: Movement, skeleton: Skeleton) -> Movement:
    """The movement mirrored left to right."""
    flip = movement.joints.new_tensor(MIRROR)
    twins = joint_twins(skeleton)
    return movement._replace(
        joints=movement.joints[..., twins, :] * flip, R_world_root=movement.R_world_root * torch.outer(flip, flip)
    )


class MovementWindows(SeededWindows):
    """Windows of true motion for Lightning."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        features: MotionFeatures,
        window: int,
        stride: int,
        batch_size: int,
        steps_per_epoch: int | None = None,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        augment: bool = True,
        balance: float = 1.0,
        val_sources: dict[str, dict | None] | None = None,
    ):
        """See `SeededWindows` and `MovementDataset`; `augment` and `balance` are for training alone."""
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.features, self.window, self.stride = features, window, stride
        self.augment, self.balance = augment, balance

    def dataset(self, split: str) -> MovementDataset:
        train = split == "train"
        return MovementDataset(
            self.sources if train else self.val_sources,
            split,
            features=self.features,
            window=self.window,
            stride=self.stride,
            augment=self.augment and train,
            balance=self.balance if train else 1.0,
        )
