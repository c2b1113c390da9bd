"""HMD² while things happen: moments go in as they come, poses come out every `stride` frames (thesis eq. 6.5).

Windows, noise and hanging are those of `HMD2.capture`: with the same seed, and a pipeline that is `live` (its floor is
what had been seen by then), the poses are the same. Memory is that of a window and of the points that are kept.
"""

import json
import math
from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import safetensors
import torch
from jaxtyping import Float, Float64
from safetensors.torch import load_file, save
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.data.surroundings import latest_before
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate_held
from wearcap.pipelines.hmd2 import HMD2
from wearcap.pipelines.hmd2_places import Memory, Places
from wearcap.pipelines.hmd2_track import Chunk, HeadTrack
from wearcap.pipelines.hmd2_windows import Frames, Poses, WindowSampler, advance
from wearcap.recording import Motion
from wearcap.recording.serialize import KNOWN, flatten, unflatten
from wearcap.scene.voxels import VoxelGrid

_KEY = "wearcap_stream"


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


class _Lane:
    """One wearer of a session: what came and is not used yet, and the windows so far."""

    def __init__(self, pipeline: HMD2, wearer: Wearer, seed: int, memory: Memory):
        self.pipeline, self.wearer, self.seed = pipeline, wearer, seed
        self.track = HeadTrack(pipeline.fps, pipeline.advance)
        grid = VoxelGrid() if pipeline.place_encoder is None else pipeline.place_encoder.grid
        self.places = Places(grid, wearer.skeleton.height_of("head"), pipeline.fps, memory)
        self.sampler: WindowSampler | None = None
        self.times = torch.zeros(0, dtype=torch.float64)
        """Of the frames that are said and not given yet."""
        self.pictures: list[tuple[float, Tensor]] = []
        """Time and embedding (NaN where it was not finite) of the newest that was used, and of those to come."""
        self.floors: list[tuple[float, float]] = []

    def take(self, sensed: Sensed) -> None:
        pipeline, net = self.pipeline, self.pipeline.net
        if not math.isfinite(sensed.timestamp):
            self.track.dropped += 1
            return
        self.track.take(sensed.timestamp, sensed.T_world_device)
        if sensed.points_world is not None and net.points_size and "points" in pipeline.use:
            self.places.add(sensed.points_world, sensed.timestamp)
        if sensed.embedding is not None and net.image_size and "images" in pipeline.use:
            if len(sensed.embedding) != net.image_size:
                raise WearcapError(f"an embedding of {len(sensed.embedding)} features at {sensed.timestamp:.3f} s",
                                   expected=f"{net.image_size} of {pipeline.image_encoder!r}, which the network was trained on")  # fmt: skip
            insort(
                self.pictures, (sensed.timestamp, sensed.embedding.float().cpu()), key=lambda part: part[0]
            )
        if sensed.floor_height is not None and math.isfinite(sensed.floor_height):
            insort(self.floors, (sensed.timestamp, sensed.floor_height))

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
        told = (T_world_head.R, T_world_head.t, floor, points, points_valid, image, image_valid, valid)
        number = torch.arange(self.pipeline.advance)
        frames = Frames(*(part[number.clamp_max(count - 1)][None] for part in told))
        return frames._replace(valid=frames.valid & (number < count))

    def _floor(
        self, times: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"]
    ) -> Float[Tensor, "time"]:
        tracked = self.places.floor(times, t_world_head)
        if not self.floors:
            return tracked
        known, height = (torch.tensor(part, dtype=torch.float64) for part in zip(*self.floors))
        self.floors = self.floors[_newest(known, times[-1].item()) :]
        return interpolate_held(known, height.float(), times)

    def give(self, waiting: int) -> list[Motion]:
        """The poses that wait, but for the last `waiting` frames; none or one motion."""
        if self.sampler is None or len(self.times) <= waiting:
            return []
        poses, T_world_head = self.sampler.give(waiting)
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
        }
        return {f"{part}.{name}": value for part, inner in parts.items() for name, value in inner.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        parts: dict[str, dict[str, Tensor]] = {}
        for key, value in state.items():
            part, _, name = key.partition(".")
            parts.setdefault(part, {})[name] = value
        self.track.restore(parts["track"])
        self.places.restore(parts["places"])
        self.times = parts["waiting"]["times"]
        if "sampler" in parts:
            self.sampler = WindowSampler.restored(self.pipeline, parts["sampler"])
        self.pictures = list(zip(parts["pictures"]["time"].tolist(), parts["pictures"]["embedding"]))
        self.floors = [(time, height) for time, height in parts["floors"]["known"].tolist()]


class Session:
    """A streaming capture of one or several wearers with one pipeline; each has a clock of their own.

    Poses wait until `stride` frames, and the `waiting` ones behind them, have come; what waits at a gap is given with what
    comes behind it. Moments may come late or out of order within those frames; later ones
    count as `dropped` (their points and pictures still serve). A pose that is missing or not finite is interpolated;
    at a chunk's end, where no newer one is known yet, the last is held, and put right for the windows that follow.
    After a gap or jump (`hmd2.MAX_GAP_S`, `MAX_SPEED_M_S`) the capture begins anew, and nothing is said of the gap.
    """

    def __init__(
        self, pipeline: HMD2, wearers: Sequence[Wearer], seeds: Sequence[int], memory: Memory | None = None
    ):
        """Raises WearcapError when there is not one seed per wearer, or for a stride or lookahead that the windows cannot have."""
        if len(wearers) != len(seeds) or not wearers:
            raise WearcapError(
                f"{len(seeds)} seeds for {len(wearers)} wearers", expected="one for each wearer"
            )
        pipeline.prepare()
        self.pipeline, self.memory, self._waiting = pipeline, memory or Memory(), pipeline.waiting
        self._lanes = [_Lane(pipeline, wearer, seed, self.memory) for wearer, seed in zip(wearers, seeds)]

    @property
    def dropped(self) -> list[int]:
        """Poses of each wearer that came too late, twice, or were not finite."""
        return [lane.track.dropped for lane in self._lanes]

    def push(self, sensed: Sequence[Sequence[Sensed]]) -> list[Motion | None]:
        """Take in each wearer's new moments (any number, also none); poses of each whose next frames are complete.

        Raises WearcapError for embeddings of another length than the network knows.
        """
        if len(sensed) != len(self._lanes):
            raise WearcapError(f"moments of {len(sensed)} wearers", expected=f"of {len(self._lanes)}, as the session has")  # fmt: skip
        for lane, moments in zip(self._lanes, sensed):
            for moment in moments:
                lane.take(moment)
        return self._run(ended=False)

    def flush(self) -> list[Motion | None]:
        """Poses of the frames that still wait, when nothing more will come."""
        return self._run(ended=True)

    def _run(self, ended: bool) -> list[Motion | None]:
        said: list[list[Motion]] = [[] for _ in self._lanes]
        while chunks := {i: chunk for i, lane in enumerate(self._lanes) if (chunk := lane.track.next(ended))}:
            for i, chunk in chunks.items():
                if chunk.begins:
                    said[i] += self._lanes[i].give(0)
            with self.pipeline.undisturbed():
                self._advance(chunks)
            for i in chunks:
                said[i] += self._lanes[i].give(self._waiting)
        for parts, lane in zip(said, self._lanes):
            parts += lane.give(0) if ended else []
        return [joined(parts) for parts in said]

    @torch.inference_mode()
    def _advance(self, chunks: dict[int, Chunk]) -> None:
        """Say one chunk of some wearers, in one batch."""
        samplers, fresh = [], []
        for i, chunk in chunks.items():
            lane = self._lanes[i]
            T_device_head = Rigid(lane.wearer.R_head_device, lane.wearer.t_head_device).inverse()
            fresh.append(lane.frames(chunk, chunk.T_world_device @ T_device_head))
            lane.times = torch.cat([lane.times, chunk.timestamps])
            if chunk.begins or lane.sampler is None:
                lane.sampler = self.pipeline.sampler(lane.wearer.skeleton, lane.seed, chunk.first)
            elif len(chunk.amended.t):
                lane.sampler.amend(chunk.amended @ T_device_head)
            samplers.append(lane.sampler)
        advance(samplers, fresh)

    def save(self, path: str | Path) -> None:
        """Write everything that the poses to come depend on, but the pipeline (.safetensors)."""
        tensors = {
            f"{i}.{name}": value for i, lane in enumerate(self._lanes) for name, value in lane.state().items()
        }
        wearers, about = zip(*(flatten(lane.wearer, f"{i}.wearer") for i, lane in enumerate(self._lanes)))
        for part in about:
            tensors |= part
        head = {
            "wearers": wearers, "seeds": [lane.seed for lane in self._lanes], "pipeline": _settings(self.pipeline),
            "radius_m": self.memory.radius_m, "max_points": self.memory.max_points,
        }  # fmt: skip
        with atomic_path(path) as temporary:
            tensors = {name: value.contiguous().clone() for name, value in tensors.items()}
            temporary.write_bytes(save(tensors, {_KEY: json.dumps(head)}))

    @classmethod
    def load(cls, path: str | Path, pipeline: HMD2) -> "Session":
        """The session that was saved, with the pipeline that it ran with.

        Raises WearcapError for a file that is no session's, and for a pipeline with other settings.
        """
        try:
            with safetensors.safe_open(str(path), framework="pt") as file:
                head = json.loads((file.metadata() or {})[_KEY])
            tensors = load_file(path)
        except (OSError, safetensors.SafetensorError, KeyError, ValueError) as error:
            raise WearcapError("not a saved session", where=path, expected="a .safetensors file of Session.save") from error  # fmt: skip
        ours = _settings(pipeline)
        wrong = [name for name, value in head["pipeline"].items() if ours.get(name) != value]
        if wrong:
            raise WearcapError(f"a session with {wrong[0]} {head['pipeline'][wrong[0]]}, not {ours.get(wrong[0])}", where=path,
                               fix="Load it with the pipeline it ran with.")  # fmt: skip
        known = KNOWN | {"Wearer": Wearer}
        wearers = [unflatten(tree, tensors.__getitem__, known) for tree in head["wearers"]]
        session = cls(pipeline, wearers, head["seeds"], Memory(head["radius_m"], head["max_points"]))
        for i, lane in enumerate(session._lanes):
            own = {name.partition(".")[2]: part for name, part in tensors.items() if name.startswith(f"{i}.")}
            lane.restore({name: part for name, part in own.items() if not name.startswith("wearer.")})
        return session


def _settings(pipeline: HMD2) -> dict[str, float | str]:
    """What of a pipeline the state depends on."""
    net = pipeline.net
    return {
        "window": net.window, "stride": pipeline.advance, "steps": pipeline.steps, "fps": pipeline.fps,
        "hold": pipeline.hold, "fade": pipeline.fade, "lookahead": pipeline.waiting,
        "eta": pipeline.eta, "spacing": pipeline.spacing, "motion_size": net.motion_size, "points_size": net.points_size, "image_size": net.image_size,
        "features": str(pipeline.features),
    }  # fmt: skip


def _newest(known: Float64[Tensor, "known"], time: float) -> int:
    """Number of the newest that is known at a time, or 0."""
    return max(0, int(torch.searchsorted(known, time + 1e-4, right=True)) - 1)


def joined(parts: list[Motion]) -> Motion | None:
    """Consecutive pieces of a motion as one; None for no piece."""
    if len(parts) < 2:
        return parts[0] if parts else None
    contacts, skin = (
        [value for part in parts if (value := getattr(part, name)) is not None]
        for name in ("contact_prob", "body_contact_prob")
    )
    tracks: dict[str, list[Trajectory]] = {}
    for part in parts:
        for name, track in (part.object_motion or {}).items():
            tracks.setdefault(name, []).append(track)
    return Motion(
        torch.cat([part.timestamps for part in parts]), parts[0].skeleton,
        torch.cat([part.R_parent_joint for part in parts]), torch.cat([part.t_world_root for part in parts]),
        torch.cat(contacts) if contacts else None, body_contact_prob=torch.cat(skin) if skin else None,
        object_motion={name: _end_to_end(each) for name, each in tracks.items()} or None,
        provenance=parts[0].provenance,
    )  # fmt: skip


def _end_to_end(tracks: list[Trajectory]) -> Trajectory:
    times, R, t = zip(*((each.timestamps, each.R_world_body, each.t_world_body) for each in tracks))
    return Trajectory(torch.cat(times), torch.cat(R), torch.cat(t))
