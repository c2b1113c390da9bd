"""One wearer of an HMD² stream: its input buffers and its window sampler."""

from bisect import insort
from typing import SupportsFloat

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.data.surroundings import latest_before
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import Motion
from wearcap.runtime.wearer import Wearer
from wearcap.scene.voxels import VoxelGrid
from wearcap.sensors import packets
from wearcap.sensors.packets import Admitted, HeadInput
from wearcap.sensors.samples import HeadSample
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory, Places
from wearcap.systems.hmd2.windows import Frames, Poses, WindowSampler
from wearcap.tracking.head_path import Chunk, HeadTrack
from wearcap.tracking.refinement import Refiner

MAX_WAITING = 1000
"""Most image embeddings, and most floor heights, that are buffered for coming head poses; the oldest are dropped."""


class WearerState:
    """State of one wearer in a session: checked packets that are not used yet, map, and windows."""

    def __init__(self, pipeline: HMD2, wearer: Wearer, seed: int, memory: Memory):
        self.pipeline, self.wearer, self.seed, self.memory = pipeline, wearer, seed, memory
        self.door = HeadInput()
        self.finished: list[Motion] = []
        """Motions from before the clock was set back that were not returned yet."""
        self.track = HeadTrack(pipeline.model.fps, pipeline.advance)
        self.begin()

    def begin(self) -> None:
        """Restart the capture; only the counts of dropped and refused packets are kept."""
        pipeline, dropped = self.pipeline, self.track.dropped
        self.track = HeadTrack(pipeline.model.fps, pipeline.advance)
        self.track.dropped = dropped
        grid = VoxelGrid() if pipeline.model.place_encoder is None else pipeline.model.place_encoder.grid
        stature = self.wearer.skeleton.height_of("head")
        self.places = Places(grid, stature, pipeline.model.fps, self.memory)
        self.sampler: WindowSampler | None = None
        self.refiner: Refiner | None = None
        self.times = torch.zeros(0, dtype=torch.float64)
        """Timestamps of the frames that were sampled but not output yet."""
        self.pictures: list[tuple[float, Tensor]] = []
        """Time and embedding (NaN if it was refused) of the last image used, and of those not used yet."""
        self.floors: list[tuple[float, float]] = []
        """Time and floor height (m) of the last measurement used, and of those not used yet."""

    @property
    def dropped(self) -> int:
        """Number of poses that were late, duplicated or refused."""
        return self.track.dropped + self.door.dropped

    @property
    def refused(self) -> dict[str, int]:
        """Number of refused samples, or parts of samples, by reason."""
        return dict(self.door.refused)

    def admit(self, sensed: object) -> Admitted:
        """Check a packet; returns the packets that are accepted now."""
        door = self.door
        if not isinstance(sensed, HeadSample):
            door.refuse("head", packets.WRONG_TYPE)
            return Admitted([])
        if not door.timely(sensed.timestamp):
            return Admitted([])
        time, points = float(sensed.timestamp), None
        if self.pipeline.model.net.points_size and "points" in self.pipeline.use:
            points = door.points(sensed.points_world)
        embedding = sensed.embedding if self.shows_pictures else None
        if embedding is not None:
            size = self.pipeline.model.net.image_size
            if fault := packets.values_fault(embedding, (size,), packets.MAX_FEATURE):
                door.refuse("embedding", fault)
                embedding = torch.full((size,), torch.nan)  # no image is used until the next valid one
            else:
                embedding = packets.owned(embedding)
        parts = points, embedding, self._floor_height(sensed.floor_height)
        return door.admit(time, HeadSample(time, door.pose(sensed.T_world_device), *parts))

    @property
    def shows_pictures(self) -> bool:
        """Whether image embeddings condition the model."""
        return bool(self.pipeline.model.net.image_size) and "images" in self.pipeline.use

    def _floor_height(self, height: object) -> float | None:
        if height is None:
            return None
        if fault := packets.number_fault(height, packets.MAX_POSITION_M):
            self.door.refuse("floor height", fault)
            return None
        assert isinstance(height, SupportsFloat)
        return float(height)

    def take(self, sensed: HeadSample) -> None:
        """Add a checked packet to the buffers."""
        self.track.take(sensed.timestamp, sensed.T_world_device)
        if sensed.points_world is not None:
            self.places.add(sensed.points_world, sensed.timestamp)
        if sensed.embedding is not None:
            insort(self.pictures, (sensed.timestamp, sensed.embedding), key=lambda part: part[0])
            del self.pictures[:-MAX_WAITING]
        if sensed.floor_height is not None:
            insort(self.floors, (sensed.timestamp, sensed.floor_height))
            del self.floors[:-MAX_WAITING]

    def frames(self, chunk: Chunk, T_world_head: Rigid) -> Frames:
        """Conditioning of a chunk, padded to the stride by its last frame, marked as not valid."""
        net, times, count = self.pipeline.model.net, chunk.timestamps, len(chunk.timestamps)
        floor = self.places.floor(times, T_world_head.t)
        if self.floors:  # measured heights take the place of tracked ones
            measured, height = (torch.tensor(part, dtype=torch.float64) for part in zip(*self.floors))
            self.floors = self.floors[_newest(measured, times[-1].item()) :]
            floor = interpolate_clamped(measured, height.float(), times)
        points, points_valid = torch.zeros(count, net.points_size), torch.zeros(count, dtype=torch.bool)
        if self.places.mapped and self.pipeline.model.place_encoder is not None:
            points = self.pipeline.model.place_encoder.encode(self.places.map.voxelize(chunk.T_world_device, times))
            points_valid = torch.ones(count, dtype=torch.bool)
        image, image_valid = torch.zeros(count, net.image_size), torch.zeros(count, dtype=torch.bool)
        if self.pictures:
            shown = torch.tensor([time for time, _ in self.pictures], dtype=torch.float64)
            number, image_valid = latest_before(shown, times)
            image = torch.stack([self.pictures[i][1] for i in number.tolist()])
            image_valid &= image.isfinite().all(-1)
            image = image.nan_to_num(0.0, 0.0, 0.0)
            self.pictures = self.pictures[_newest(shown, times[-1].item()) :]
        valid = torch.ones(count, dtype=torch.bool)
        fields = (T_world_head.R, T_world_head.t, floor, points, points_valid, image, image_valid, valid)
        number = torch.arange(self.pipeline.advance)
        frames = Frames(*(part[number.clamp_max(count - 1)][None] for part in fields))
        return frames._replace(valid=frames.valid & (number < count))

    def finalize(self, lookahead_frames: int) -> list[Motion]:
        """Newly final poses, all but the last `lookahead_frames` and those that wait for refinement, as a list of at
        most one motion."""
        if self.sampler is None or len(self.times) <= lookahead_frames:
            return []
        poses, measured = self.sampler.finalize(lookahead_frames)
        times, self.times = self.times.tensor_split([len(measured.floor_height)])
        poses, T_world_head = Poses(*(part[0] for part in poses)), Rigid(measured.R_world_head, measured.t_world_head)
        motion = self.pipeline.motion(times, self.wearer.skeleton, T_world_head, poses)
        if self.pipeline.refinement is None:
            return [motion]
        if self.refiner is None:
            self.refiner = Refiner(self.pipeline.refinement, motion.skeleton, self.pipeline.model.fps, anchored=True)
        return self.refiner.push(motion, measured)

    def end(self) -> list[Motion]:
        """All remaining poses of a stretch, as a list of at most two motions."""
        motions = self.finalize(0)
        if self.refiner is not None:
            motions += self.refiner.finish()
        self.refiner = None
        return motions


def _newest(times: Float64[Tensor, "sample"], time: float) -> int:
    """Index of the newest sample at or before a time, or 0."""
    return max(0, int(torch.searchsorted(times, time + 1e-4, right=True)) - 1)
