"""What one wearer's devices sensed, as HMD²'s conditions: a whole recording at once, or sample by sample."""

from bisect import insort
from collections.abc import Collection

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.data.surroundings import latest_before
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import Recording
from wearcap.scene.voxels import VoxelGrid
from wearcap.sensors.samples import HeadSample
from wearcap.systems.hmd2.places import EVERYTHING, Memory, Places
from wearcap.systems.hmd2.windows import DiffusionModel, Frames

MODALITIES = ("points", "images")
MAX_WAITING = 1000
"""Most image embeddings, and most floor heights, that are buffered for coming head poses; the oldest are dropped."""
_AT_ONCE = 2048
"""Voxel grids that are encoded at a time."""


class Sensing:
    """What was sensed so far and later frames need: points of the surroundings, image embeddings, floor heights."""

    def __init__(self, model: DiffusionModel, use: Collection[str], stature: float, memory: Memory = EVERYTHING):
        """`use`: modalities that condition the model; `stature`: the head joint's height in the rest pose (m)."""
        self.model, net = model, model.net
        self.uses_points, self.uses_images = (
            bool(size) and name in use for name, size in zip(MODALITIES, (net.points_size, net.image_size))
        )
        grid = VoxelGrid() if model.place_encoder is None else model.place_encoder.grid
        self.places = Places(grid, stature, model.fps, memory)
        self.images: list[tuple[float, Tensor]] = []
        """Time and embedding (NaN if it was refused) of the last image used, and of those not used yet."""
        self.floors: list[tuple[float, float]] = []
        """Time and floor height (m) of the last measurement used, and of those not used yet."""

    @classmethod
    def of(cls, model: DiffusionModel, use: Collection[str], recording: Recording, stature: float) -> "Sensing":
        """Everything that a whole recording sensed.

        Raises WearcapError for embeddings of an encoder that the network was not trained on.
        """
        sensing = cls(model, use, stature)
        cloud, camera = recording.points, recording.camera
        if sensing.uses_points and cloud is not None:
            sensing.places.add(cloud.points_world, cloud.first_seen)
        if sensing.uses_images and camera is not None and camera.embedding is not None:
            size = camera.embedding.shape[1]
            if (camera.embedding_name, size) != (model.image_encoder, model.net.image_size):
                what = f"embeddings of {camera.embedding_name!r} with {size} features"
                expected = f"{model.net.image_size} of {model.image_encoder!r}, which the network was trained on"
                fix = "Prepare its embeddings with that encoder, or leave images out: pipeline.use=[points]."
                raise WearcapError(what, where=recording.name, expected=expected, fix=fix)
            sensing.images = list(zip(camera.timestamps.tolist(), camera.embedding))
        return sensing

    def take(self, sample: HeadSample) -> None:
        """Take in what a checked sample of a stream holds beside the head's pose."""
        if sample.points_world is not None:
            seen = torch.full((len(sample.points_world),), sample.timestamp, dtype=torch.float64)
            self.places.add(sample.points_world, seen)
        if sample.embedding is not None:
            insort(self.images, (sample.timestamp, sample.embedding), key=lambda image: image[0])
            del self.images[:-MAX_WAITING]
        if sample.floor_height is not None:
            insort(self.floors, (sample.timestamp, sample.floor_height))
            del self.floors[:-MAX_WAITING]

    def frames(
        self,
        timestamps: Float64[Tensor, "time"],
        T_world_device: Rigid,
        T_world_head: Rigid,
        floor_height: Float[Tensor, "time"] | None = None,
    ) -> Frames:
        """Conditions of the next frames, as a batch of one.

        `floor_height` (m) takes the place of floors that were measured, and these that of the floor as tracked so far.
        """
        net, count, last_s = self.model.net, len(timestamps), timestamps[-1].item()
        if floor_height is None:
            floor_height = self.places.floor(timestamps, T_world_head.t)
            if self.floors:
                measured, height = (torch.tensor(part, dtype=torch.float64) for part in zip(*self.floors))
                floor_height = interpolate_clamped(measured, height.float(), timestamps)
                self.floors = self.floors[_newest(measured, last_s) :]
        points, points_valid = torch.zeros(count, net.points_size), torch.zeros(count, dtype=torch.bool)
        if self.places.mapped and (encoder := self.model.place_encoder) is not None:  # what had been seen by each frame
            grids = self.places.map.voxelize(T_world_device, timestamps)
            points = torch.cat([encoder.encode(part) for part in grids.split(_AT_ONCE)])
            points_valid = torch.ones(count, dtype=torch.bool)
        image, image_valid = torch.zeros(count, net.image_size), torch.zeros(count, dtype=torch.bool)
        if self.images:
            shown = torch.tensor([time for time, _ in self.images], dtype=torch.float64)
            number, image_valid = latest_before(shown, timestamps)
            image = torch.stack([self.images[k][1] for k in number.tolist()]).float()
            image_valid &= image.isfinite().all(-1)
            image = image.nan_to_num(0.0, 0.0, 0.0)
            self.images = self.images[_newest(shown, last_s) :]
        valid = torch.ones(count, dtype=torch.bool)
        fields = (
            timestamps,
            T_world_head.R,
            T_world_head.t,
            floor_height,
            points,
            points_valid,
            image,
            image_valid,
            valid,
        )
        return Frames(*(field[None] for field in fields))


def _newest(times: Float64[Tensor, "sample"], time: float) -> int:
    """Index of the newest sample at or before a time, or 0."""
    return max(0, int(torch.searchsorted(times, time + 1e-4, right=True)) - 1)
