"""What one wearer's devices sensed, as HMD²'s conditions: a whole recording at once, or sample by sample."""

from collections.abc import Collection

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import Recording
from wearcap.scene.voxels import VoxelGrid
from wearcap.sensors.samples import HeadSample
from wearcap.systems.hmd2.conditions import HeadFrames, Sensed, Timed, side_by_side
from wearcap.systems.hmd2.places import EVERYTHING, Memory, Places
from wearcap.systems.hmd2.windows import DiffusionModel, Frames


class Sensing:
    """What was sensed so far and later frames need."""

    def __init__(self, model: DiffusionModel, use: Collection[str], stature: float, memory: Memory = EVERYTHING):
        """`use`: conditions that are used (`Condition.use`); `stature`: the head joint's height in the rest pose (m)."""
        points = model.conditions.get("points")
        grid = VoxelGrid() if points is None else points.encoder.grid
        self.model, self.places = model, Places(grid, stature, model.fps, memory)
        self.used = {name: condition for name, condition in model.conditions.items() if condition.use in use}
        self.sensed = {name: Sensed(self.places, Timed(), {}) for name in self.used}
        """What was sensed for each condition that is used."""
        self.floors = Timed()
        """The last measured floor height (m) used, and those not used yet."""

    @classmethod
    def of(cls, model: DiffusionModel, use: Collection[str], recording: Recording, stature: float) -> "Sensing":
        """Everything that a whole recording sensed.

        Raises WearcapError for embeddings of an encoder that the network was not trained on.
        """
        sensing = cls(model, use, stature)
        for name, condition in sensing.used.items():
            condition.take_all(sensing.sensed[name], recording)
        return sensing

    def take(self, sample: HeadSample) -> None:
        """Take in what a checked sample of a stream holds beside the head's pose."""
        for name, condition in self.used.items():
            if (value := getattr(sample, condition.field, None)) is not None:
                condition.take(self.sensed[name], sample.timestamp, value)
        if sample.floor_height is not None:
            self.floors.add(sample.timestamp, torch.tensor(sample.floor_height))

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
        count, conditions = len(timestamps), []
        frames = HeadFrames(timestamps, T_world_device, T_world_head)
        if floor_height is None:
            floor_height = self.places.floor(timestamps, T_world_head.t)
            if len(self.floors):
                floor_height = interpolate_clamped(self.floors.times, self.floors.values, timestamps)
                self.floors.forget(timestamps[-1].item())
        for name, condition in self.model.conditions.items():
            sensed = self.sensed.get(name)
            found = None if sensed is None else condition.frames(sensed, frames)
            conditions.append(found or (torch.zeros(count, condition.size), torch.zeros(count, dtype=torch.bool)))
        valid = torch.ones(count, dtype=torch.bool)
        others, given = side_by_side(conditions, count)
        fields = timestamps, T_world_head.R, T_world_head.t, floor_height, others, given, valid
        return Frames(*(field[None] for field in fields))
