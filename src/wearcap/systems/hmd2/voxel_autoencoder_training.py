"""Training of the autoencoder of the points around the body (thesis §6.2.1, §6.4), and its windows of voxel grids."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.bodies import OtherPerson
from wearcap.data.transforms import Cut, Draws, Window
from wearcap.data.windows import Content, Windows, drawn_batches
from wearcap.metrics.detection import distance_mae_cm, occupancy_iou, occupied_distance_mae_cm
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import HeadStream
from wearcap.recording.store import RecordingFile, RecordingStore
from wearcap.scene.voxels import VoxelGrid, VoxelMap, mirrored
from wearcap.training.base import Optimization, Training


class Places(NamedTuple):
    """Voxel grids (truncated distances, m) of some frames, or a batch of them (a leading "batch" axis)."""

    grids: Float[Tensor, "*batch time x y z"]


class PlaceContent(Content):
    """Voxel grids of `frames` random frames of each window, of recordings that have points.

    A track is a recording's map of points, and its head stream.
    """

    requires = " with points that tracking found"
    tracks_at_once = 512

    def __init__(self, grid: VoxelGrid, frames: int):
        self.grid, self.frames = grid, frames

    def usable(self, store: RecordingStore, name: str) -> bool:
        file = RecordingFile(store.path_of(name))
        return "points.points_world" in file.keys and file.length("points.points_world") > 0

    def min_frames(self, window: int, stretch: float) -> int:
        return 1

    def open(
        self, store: RecordingStore, name: str, every: int, person: OtherPerson | None = None
    ) -> tuple[VoxelMap, HeadStream]:
        file = RecordingFile(store.path_of(name))
        cloud, head, surroundings = file.part("points"), file.part("head"), VoxelMap(self.grid)
        surroundings.add(cloud.points_world, cloud.first_seen)
        return surroundings, head

    def read(self, track: tuple[VoxelMap, HeadStream], cut: Cut, random: Draws) -> Window:
        (surroundings, head), valid = track, int(cut.valid.sum())
        chosen = cut.frames[torch.randint(valid, (self.frames,), generator=random.generator)]
        return Window({"grids": surroundings.voxelize(head.T_world_device[chosen], head.timestamps[chosen])})

    def item(self, track: tuple[VoxelMap, HeadStream], cut: Cut, window: Window, random: Draws) -> Places:
        return Places(mirrored(window.values["grids"]) if window.mirrored else window.values["grids"])


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
