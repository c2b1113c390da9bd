"""HMD²'s conditions beside the head's path: what the system knows of one of them stands in its class.

A condition has features per frame, and any frame may lack them. The README beside this file shows how to add one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import msgspec
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.data.surroundings import HAND, Features, hand_features, latest_before
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import Recording
from wearcap.runtime.graphs import Call, Count, Graph, Run
from wearcap.scene.voxels import VoxelGrid
from wearcap.sensors import packets
from wearcap.sensors.packets import HeadInput
from wearcap.systems.hmd2.places import Places
from wearcap.tracking.wrists import seen_wrist

MAX_WAITING = 1000
"""Most values that are buffered for coming head poses; the oldest are dropped."""
_AT_ONCE = 2048
"""Voxel grids that are encoded at a time."""


class Timed:
    """Values in order of time."""

    def __init__(self):
        self.times, self.values = torch.zeros(0, dtype=torch.float64), torch.zeros(0)

    def __len__(self) -> int:
        return len(self.times)

    def add(self, time: float, value: Float[Tensor, "*size"]) -> None:
        """Add a value, after those of the same time; beyond `MAX_WAITING` the oldest are dropped."""
        order = torch.cat([self.times, self.times.new_tensor([time])]).argsort(stable=True)[-MAX_WAITING:]
        self.values = torch.cat([self.values, value[None]] if len(self) else [value[None]])[order]
        self.times = torch.cat([self.times, self.times.new_tensor([time])])[order]

    def forget(self, time: float) -> None:
        """Drop the values before the newest one at or before a time."""
        first = max(0, int(torch.searchsorted(self.times, time + 1e-4, right=True)) - 1)
        self.times, self.values = self.times[first:], self.values[first:]


class HeadFrames(NamedTuple):
    """The frames of a head's path."""

    timestamps: Float64[Tensor, "time"]
    T_world_device: Rigid
    T_world_head: Rigid


class Sensed(NamedTuple):
    """What one wearer's devices sensed for a condition, as far as coming frames need it."""

    places: Places
    """The wearer's map of points."""
    values: Timed
    """The last value used, and those not used yet; NaN if refused."""
    tracked: dict[str, Trajectory]
    """Tracked wrists."""


class Exported(msgspec.Struct):
    """What an exported model's sidecar holds of a condition."""

    size: Count
    encoder: str | None = None
    grid: VoxelGrid | None = None


@dataclass(frozen=True, eq=False)
class Condition:
    """A condition as one network has it; here one whose frames have the newest value that a stream's samples brought."""

    size: int
    """Number of features of a frame."""
    encoder: Any = None
    """The network that makes the features (frozen), or the name of the one that made them; None: neither."""
    drop: float = 0.0
    """Probability per training window that no frame has it, so that one checkpoint runs with and without it."""

    use: ClassVar[str]
    """Its word in `pipeline.use`."""
    field: ClassVar[str]
    """Its field of a stream's samples."""
    weights: ClassVar[str | None] = None
    """Prefix of the encoder's weights in a checkpoint; None: it has none."""
    measures_floor: ClassVar[bool] = False
    """Whether the floor below a frame that has it is known."""

    def take_all(self, sensed: Sensed, recording: Recording) -> None:
        """Take in a whole recording."""
        raise NotImplementedError

    def checked(self, value: Any, head: HeadInput) -> Any:
        """A valid copy of a sample's value; `head` counts what is refused, for which NaN stand in until the next one."""
        if value is not None and (fault := packets.values_fault(value, (self.size,), packets.MAX_FEATURE)):
            head.refuse(self.field, fault)
            value = torch.full((self.size,), torch.nan)
        return None if value is None else packets.owned(value)

    def take(self, sensed: Sensed, time: float, value: Tensor) -> None:
        """Take in a checked value of a stream."""
        sensed.values.add(time, value)

    def frames(self, sensed: Sensed, frames: HeadFrames) -> Features | None:
        """Features of the next frames; None: they have none."""
        if not len(sensed.values):
            return None
        number, valid = latest_before(sensed.values.times, frames.timestamps)
        features = sensed.values.values[number].float()
        sensed.values.forget(frames.timestamps[-1].item())
        return features.nan_to_num(0.0, 0.0, 0.0), valid & features.isfinite().all(-1)

    def graphs(self, random: torch.Generator) -> dict[str, Graph]:
        """Graphs of its encoder that exported models have."""
        return {}

    @classmethod
    def of_export(cls, entry: Exported, runs: dict[str, Run]) -> "Condition":
        """The condition of an exported model."""
        return cls(entry.size, entry.encoder)


class Points(Condition):
    """Codes of the points around the body, by a voxel autoencoder (thesis §6.2), as they had been seen by each frame."""

    use, field, weights, measures_floor = "points", "points_world", "place_encoder", True

    def __init__(self, encoder: VoxelAutoencoder, drop: float = 0.0):
        super().__init__(encoder.size, encoder.requires_grad_(False).eval(), drop)

    def take_all(self, sensed: Sensed, recording: Recording) -> None:
        if (cloud := recording.points) is not None:
            sensed.places.add(cloud.points_world, cloud.first_seen)

    def checked(self, value: Any, head: HeadInput) -> Any:
        return head.points(value)

    def take(self, sensed: Sensed, time: float, value: Tensor) -> None:
        sensed.places.add(value, torch.full((len(value),), time, dtype=torch.float64))

    def frames(self, sensed: Sensed, frames: HeadFrames) -> Features | None:
        if not sensed.places.mapped:
            return None
        grids = sensed.places.map.voxelize(frames.T_world_device, frames.timestamps)
        codes = torch.cat([self.encoder.encode(part) for part in grids.split(_AT_ONCE)])
        return codes, torch.ones(len(codes), dtype=torch.bool)

    def graphs(self, random: torch.Generator) -> dict[str, Graph]:
        grid = self.encoder.grid
        grids = grid.clip_m * torch.rand(2, *[grid.cells] * 3, generator=random)
        return {"places": Graph(Call(self.encoder, "encode"), {"grids": grids})}

    @classmethod
    def of_export(cls, entry: Exported, runs: dict[str, Run]) -> "Points":
        return cls(_ExportedPlaces(runs["places"], entry))


class Images(Condition):
    """Embeddings of the head camera's images by the encoder of a name."""

    use, field = "images", "embedding"

    def take_all(self, sensed: Sensed, recording: Recording) -> None:
        """Raises WearcapError for embeddings of an encoder that the network was not trained on."""
        if (camera := recording.camera) is None or camera.embedding is None:
            return
        if (camera.embedding_name, camera.embedding.shape[1]) != (self.encoder, self.size):
            what = f"embeddings of {camera.embedding_name!r} with {camera.embedding.shape[1]} features"
            expected = f"{self.size} of {self.encoder!r}, which the network was trained on"
            fix = "Prepare its embeddings with that encoder, or leave images out: pipeline.use=[points]."
            raise WearcapError(what, where=recording.name, expected=expected, fix=fix)
        sensed.values.times, sensed.values.values = camera.timestamps.contiguous(), camera.embedding


class Hands(Condition):
    """Wrists as far as they are seen: by cameras of glasses or a headset, or as tracked controllers (ours)."""

    use, field = "hands", "wrists"

    def __init__(self, size: int = HAND * len(WRISTS), encoder: None = None, drop: float = 0.0):
        super().__init__(size, encoder, drop)

    def take_all(self, sensed: Sensed, recording: Recording) -> None:
        sensed.tracked.update({joint: recording.tracked[joint] for joint in WRISTS if joint in recording.tracked})

    def frames(self, sensed: Sensed, frames: HeadFrames) -> Features | None:
        found = [seen_wrist(sensed.tracked.get(joint), frames.timestamps) for joint in WRISTS]
        T_world_wrist = Rigid(*(torch.stack([getattr(T, part) for T, _ in found], 1) for part in "Rt"))
        seen = torch.stack([there for _, there in found], 1)
        return hand_features(frames.T_world_head, T_world_wrist, seen), seen.any(-1)


class _ExportedPlaces(VoxelAutoencoder):
    """The encoder of the points around the body, with its weights in an exported file."""

    def __init__(self, run: Run, entry: Exported):
        torch.nn.Module.__init__(self)
        self._run, self.grid, self.size = run, entry.grid or VoxelGrid(), entry.size

    def encode(self, grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch feature"]:
        flat = grids.reshape(-1, *grids.shape[-3:])
        return self._run(grids=flat).reshape(*grids.shape[:-3], self.size)


CONDITIONS: dict[str, type[Condition]] = {"points": Points, "image": Images, "hands": Hands}
"""Every condition by its name in configs, batches and exported graphs."""


def side_by_side(
    parts: Sequence[tuple[Tensor, Tensor]], count: int
) -> tuple[Float[Tensor, "time feature"], Bool[Tensor, "time condition"]]:
    """Conditions of `count` frames as a network takes them (`model.Conditions`)."""
    features, valid = zip(*parts) if parts else ((), ())
    none = torch.zeros(count, 0)
    return torch.cat([none, *features], -1), torch.stack(valid, -1) if parts else none.bool()
