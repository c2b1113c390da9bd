"""One wearer of an HMD² stream: what the device gave and is not used yet, and the windows so far."""

from bisect import insort
from dataclasses import dataclass, field
from typing import NamedTuple, SupportsFloat

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.data.surroundings import latest_before
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import Motion
from wearcap.scene.voxels import VoxelGrid
from wearcap.sensors.packets import (
    AGREEING,
    MAX_POSITION_M,
    WRONG_TYPE,
    Admitted,
    HeadInput,
    embedding_fault,
    number_fault,
    owned,
)
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory, Places
from wearcap.systems.hmd2.windows import Frames, Poses, WindowSampler
from wearcap.tracking.head_track import Chunk, HeadTrack

MAX_WAITING = 1000
"""Pictures, and floor heights, that wait for a pose; the oldest make room."""


class Sensed(NamedTuple):
    """What one wearer's device gave at one moment; None where it gave nothing."""

    timestamp: float
    """Seconds, on the wearer's own clock."""
    T_world_device: Rigid | None = None
    """R "3 3", t "3" (m); the device frame has the head's axes."""
    points_world: Float[Tensor, "point 3"] | None = None
    """Points of the surroundings that are new, in the world of the poses. No row: there is a map, and nothing new."""
    embedding: Float[Tensor, "feature"] | None = None
    """Of the picture that the head camera took at this moment."""
    floor_height: float | None = None
    """Where it is known from elsewhere (m); else the points tell it, or the head's path."""


@dataclass(frozen=True)
class Wearer:
    """Who wears a device, and how it sits on the head joint."""

    skeleton: Skeleton
    R_head_device: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3))
    t_head_device: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3))


class WearerState:
    """One wearer of a session: what came and is not used yet, and the windows so far."""

    def __init__(self, pipeline: HMD2, wearer: Wearer, seed: int, memory: Memory):
        self.pipeline, self.wearer, self.seed, self.memory = pipeline, wearer, seed, memory
        self.door = HeadInput()
        self.track = HeadTrack(pipeline.fps, pipeline.advance)
        self.begin()

    def begin(self) -> None:
        """Begin anew: of what came before, the counts alone stay."""
        pipeline, dropped = self.pipeline, self.track.dropped
        self.track = HeadTrack(pipeline.fps, pipeline.advance)
        self.track.dropped = dropped
        grid = VoxelGrid() if pipeline.place_encoder is None else pipeline.place_encoder.grid
        stature = self.wearer.skeleton.height_of("head")
        self.places = Places(grid, stature, pipeline.fps, self.memory)
        self.sampler: WindowSampler | None = None
        self.times = torch.zeros(0, dtype=torch.float64)
        """Of the frames that are said and not given yet."""
        self.pictures: list[tuple[float, Tensor]] = []
        """Time and embedding (NaN where it was not usable) of the newest that was used, and of those to come."""
        self.floors: list[tuple[float, float]] = []

    @property
    def dropped(self) -> int:
        """Poses that came too late, twice, or were refused."""
        return self.track.dropped + self.door.dropped

    def admit(self, sensed: object) -> Admitted:
        """Check a moment; the moments that are to be taken now."""
        door = self.door
        if not isinstance(sensed, Sensed):
            door.refuse("head", WRONG_TYPE)
            return Admitted([])
        if not door.timely(sensed.timestamp):
            return Admitted([])
        time, points = float(sensed.timestamp), None
        if self.pipeline.net.points_size and "points" in self.pipeline.use:
            points = door.points(sensed.points_world)
        parts = points, self._embedding(sensed.embedding), self._floor_height(sensed.floor_height)
        return door.admit(time, Sensed(time, door.pose(sensed.T_world_device), *parts))

    @property
    def shows_pictures(self) -> bool:
        """Whether embeddings are used."""
        return bool(self.pipeline.net.image_size) and "images" in self.pipeline.use

    def _embedding(self, embedding: object) -> Float[Tensor, "feature"] | None:
        """A copy; NaN where the picture cannot be used, so that none is believed until the next one."""
        size = self.pipeline.net.image_size
        if embedding is None or not self.shows_pictures:
            return None
        fault = embedding_fault(embedding, size)
        if fault is None:
            assert isinstance(embedding, Tensor)
            return owned(embedding)
        self.door.refuse("embedding", fault)
        return torch.full((size,), torch.nan)

    def _floor_height(self, height: object) -> float | None:
        if height is None:
            return None
        if fault := number_fault(height, MAX_POSITION_M):
            self.door.refuse("floor height", fault)
            return None
        assert isinstance(height, SupportsFloat)
        return float(height)

    def take(self, sensed: Sensed) -> None:
        """Take in a moment that was checked."""
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
        """What the network is told of a chunk, filled up to the stride with its last frame as not valid."""
        net, times, count = self.pipeline.net, chunk.timestamps, len(chunk.timestamps)
        floor = self._floor(times, T_world_head.t)
        points, points_valid = torch.zeros(count, net.points_size), torch.zeros(count, dtype=torch.bool)
        if self.places.mapped and self.pipeline.place_encoder is not None:
            points = self.pipeline.place_encoder.encode(self.places.grids(chunk.T_world_device, times))
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
        conditions = (T_world_head.R, T_world_head.t, floor, points, points_valid, image, image_valid, valid)
        number = torch.arange(self.pipeline.advance)
        frames = Frames(*(part[number.clamp_max(count - 1)][None] for part in conditions))
        return frames._replace(valid=frames.valid & (number < count))

    def _floor(
        self, times: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"]
    ) -> Float[Tensor, "time"]:
        tracked = self.places.floor(times, t_world_head)
        if not self.floors:
            return tracked
        observed, height = (torch.tensor(part, dtype=torch.float64) for part in zip(*self.floors))
        self.floors = self.floors[_newest(observed, times[-1].item()) :]
        return interpolate_clamped(observed, height.float(), times)

    def give(self, lookahead_frames: int) -> list[Motion]:
        """The poses that wait, but for the last `lookahead_frames` frames; none or one motion."""
        if self.sampler is None or len(self.times) <= lookahead_frames:
            return []
        poses, T_world_head = self.sampler.give(lookahead_frames)
        times, self.times = self.times.tensor_split([len(T_world_head.t)])
        poses = Poses(*(part[0] for part in poses))
        return [self.pipeline.motion(times, self.wearer.skeleton, T_world_head, poses)]

    def state(self) -> dict[str, Tensor]:
        shown, pictures = zip(*self.pictures) if self.pictures else ((), ())
        parts = {
            "track": self.track.state(),
            "places": self.places.state(),
            "sampler": self.sampler.state() if self.sampler is not None else {},
            "waiting": {"times": self.times},
            "pictures": {
                "time": torch.tensor(shown, dtype=torch.float64),
                "embedding": torch.stack(pictures)
                if pictures
                else torch.zeros(0, self.pipeline.net.image_size),
            },
            "floors": {"known": torch.tensor(self.floors, dtype=torch.float64).reshape(-1, 2)},
            "door": self._door_state(),
        }
        return {f"{part}.{name}": value for part, inner in parts.items() for name, value in inner.items()}

    def _door_state(self) -> dict[str, Tensor]:
        clock, place = self.door.clock, self.door.place or ()
        numbers = [clock.newest, clock.taken, self.door.dropped, self.door.far, *place]
        state = {"numbers": torch.tensor(numbers, dtype=torch.float64)}
        for k, (_, sensed) in enumerate(clock.waiting):
            T, height = sensed.T_world_device, sensed.floor_height
            parts = {
                "timestamp": torch.tensor(sensed.timestamp, dtype=torch.float64),
                "R": None if T is None else T.R, "t": None if T is None else T.t,
                "points": sensed.points_world, "embedding": sensed.embedding,
                "height": None if height is None else torch.tensor(height, dtype=torch.float64),
            }  # fmt: skip
            state |= {f"{k}.{name}": part for name, part in parts.items() if part is not None}
        return state

    def _restore_door(self, state: dict[str, Tensor]) -> None:
        clock = self.door.clock
        clock.newest, taken, dropped, far, *place = state["numbers"].tolist()
        clock.taken, self.door.dropped, self.door.far = int(taken), int(dropped), int(far)
        self.door.place = (place[0], place[1], place[2]) if place else None
        while (k := len(clock.waiting)) < AGREEING and f"{k}.timestamp" in state:
            part = {
                name.partition(".")[2]: value for name, value in state.items() if name.startswith(f"{k}.")
            }
            T = Rigid(part["R"], part["t"]) if "R" in part else None
            height = part["height"].item() if "height" in part else None
            time = part["timestamp"].item()
            sensed = Sensed(time, T, part.get("points"), part.get("embedding"), height)
            clock.waiting.append((time, sensed))

    def restore(self, state: dict[str, Tensor]) -> None:
        parts: dict[str, dict[str, Tensor]] = {}
        for key, value in state.items():
            part, _, name = key.partition(".")
            parts.setdefault(part, {})[name] = value
        self.track.restore(parts["track"])
        self.places.restore(parts["places"])
        self._restore_door(parts["door"])
        self.times = parts["waiting"]["times"]
        if "sampler" in parts:
            self.sampler = WindowSampler.restored(self.pipeline, parts["sampler"])
        self.pictures = list(zip(parts["pictures"]["time"].tolist(), parts["pictures"]["embedding"]))
        self.floors = [(time, height) for time, height in parts["floors"]["known"].tolist()]


def _newest(observed: Float64[Tensor, "known"], time: float) -> int:
    """Number of the newest that is known at a time, or 0."""
    return max(0, int(torch.searchsorted(observed, time + 1e-4, right=True)) - 1)
