"""Training of the autoencoder of the points around the body (thesis §6.2.1, §6.4)."""

from collections.abc import Callable

import torch
from torch import Tensor

from wearcap.data.statistics import collate
from wearcap.metrics.occupancy import distance_mae_cm, occupancy_iou, occupied_distance_mae_cm
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.systems.hmd2.point_codes_windows import PlaceDataset, Places
from wearcap.training.base import GivenOptimizer


class VoxelReconstruction(GivenOptimizer):
    """Trains an autoencoder of voxel grids by the network's own reconstruction loss."""

    def __init__(
        self,
        net: VoxelAutoencoder,
        optimizer: Callable[..., torch.optim.Optimizer],
        scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None,
    ):
        super().__init__()
        self.net = net
        self._optimizer, self._scheduler = optimizer, scheduler

    def set_statistics(self, dataset: PlaceDataset, limit: int = 1500) -> None:
        """Initialise the weights from a training split; a resumed run loads its own."""
        random = torch.Generator().manual_seed(0)
        drawn = torch.multinomial(dataset.weights, limit, replacement=True, generator=random).tolist()
        self.net.start_from(collate([dataset[item] for item in zip(drawn, range(limit))]).grids.flatten(0, 1))

    def training_step(self, batch: Places, batch_idx: int) -> Tensor:
        grids = batch.grids.flatten(0, 1)
        loss = self.net.loss(grids)
        self.log("train/loss", loss, batch_size=len(grids), prog_bar=True)
        return loss

    def validation_step(self, batch: Places, batch_idx: int) -> None:
        grids = batch.grids.flatten(0, 1)
        rebuilt, clip_m = self.net.decode(self.net.encode(grids)), self.net.grid.clip_m
        scores = {
            "val/loss": self.net.loss(grids),
            "val/distance_cm": distance_mae_cm(rebuilt, grids),
            "val/held_distance_cm": occupied_distance_mae_cm(rebuilt, grids, clip_m),
            "val/occupancy_iou": occupancy_iou(rebuilt, grids, clip_m),
        }
        self.log_dict(scores, batch_size=len(grids), sync_dist=True)
