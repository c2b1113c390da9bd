"""Training of the autoencoder of the points around the body (thesis §6.2.1, §6.4), and its windows of voxel grids."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.batch import Batch
from wearcap.data.packing import Track
from wearcap.data.windows import Content, Windows, drawn_batches
from wearcap.metrics.detection import distance_mae_cm, occupancy_iou, occupied_distance_mae_cm
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.scene.voxels import VoxelGrid, VoxelMap, mirrored
from wearcap.training.base import Optimization, Training


class Places(NamedTuple):
    """Voxel grids (truncated distances, m) of the frames of a batch of windows."""

    grids: Float[Tensor, "batch time x y z"]


class PlaceContent(Content):
    """Voxel grids of recordings that have points, at the rate of the windows; distances are kept in 255 steps."""

    requires = " with points that tracking found"
    own_rate = True

    def __init__(self, grid: VoxelGrid):
        self.grid = grid

    def settings(self) -> Any:
        return self.grid

    def usable(self, store: RecordingStore, name: str) -> bool:
        file = RecordingFile(store.path_of(name))
        return "points.points_world" in file.keys and file.length("points.points_world") > 0

    def min_frames(self, window: int, stretch: float) -> int:
        return 1

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        cloud, head, surroundings = recording.points, recording.head, VoxelMap(self.grid)
        assert cloud is not None
        assert head is not None
        surroundings.add(cloud.points_world, cloud.first_seen)
        grids = surroundings.voxelize(head.T_world_device[::every], head.timestamps[::every])
        return Track({"grids": (255 / self.grid.clip_m * grids).round().to(torch.uint8)})

    def batch(self, batch: Batch) -> Places:
        grids = self.grid.clip_m / 255 * batch.values["grids"].float()
        if batch.mirrored is not None:
            grids = torch.where(batch.mirrored[:, None, None, None, None], mirrored(grids), grids)
        return Places(grids)


class VoxelReconstruction(Training):
    """Trains an autoencoder of voxel grids by the network's own reconstruction loss."""

    def __init__(self, net: VoxelAutoencoder, optimization: Optimization):
        super().__init__(optimization)
        self.net = net

    def set_statistics(self, dataset: Windows, limit: int = 1500) -> None:
        """Initialise the weights from a training split; a resumed run loads its own."""
        (batch,) = drawn_batches(dataset, limit)
        self.net.start_from(batch.grids.flatten(0, 1))

    def measure(self, batch: Places) -> dict[str, Tensor]:
        """The loss, and in validation the errors of the reconstructed grids."""
        grids = batch.grids.flatten(0, 1)
        loss = {"loss": self.net.loss(grids)}
        if self.training:
            return loss
        rebuilt, clip_m = self.net.decode(self.net.encode(grids)), self.net.grid.clip_m
        return loss | {
            "distance_cm": distance_mae_cm(rebuilt, grids),
            "held_distance_cm": occupied_distance_mae_cm(rebuilt, grids, clip_m),
            "occupancy_iou": occupancy_iou(rebuilt, grids, clip_m),
        }
