"""Streaming captures: samples go in as devices send them, final poses come out."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import joined
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.packets import Admitted, HeadInput, WristInput
from wearcap.sensors.samples import ActiveObject, HeadSample, ObjectSample, SuitPiece
from wearcap.tracking.head_path import MAX_GAP_S, Chunk, HeadTrack
from wearcap.tracking.refinement import Measured, Refiner


class Session:
    """A streaming capture of one or several wearers with one system; every wearer has their own clock.

    Implausible samples (`sensors.packets`) are refused and counted, and never affect other wearers.
    """

    devices: ClassVar[tuple[str, ...]] = ("head",)
    """Devices of a wearer without which there is no motion: "head", joints of wrists, "suit", "camera"."""
    optional: ClassVar[tuple[str, ...]] = ()
    """Devices that are taken where they come, and whenever they do."""
    tracks_wrists: ClassVar[bool] = False
    """Whether wrists come as tracked poses; otherwise as orientation and acceleration of watches."""
    given_floor: ClassVar[bool] = False
    """Whether a capture of a whole recording takes the floor that it has, as a stream then takes its wearer's `floor_m`."""
    takes_objects: ClassVar[bool] = False
    """Whether samples of objects, and of which one is active, are taken."""

    def __init__(self, system: Any, streams: Sequence[Any]):
        """`streams`: one for each wearer, with the properties `dropped` and `refused`, `take(sample)` for one sample, and
        `poses(ended)` for the frames that became final since the last call, or None. Raises WearcapError without any.
        """
        if not streams:
            raise WearcapError("a session without wearers", expected="one wearer or more")
        self.system, self.streams = system, list(streams)

    @classmethod
    def of_wearers(
        cls, system: Any, wearers: Sequence[Wearer], seed: int = 0, source: CaptureInput | None = None
    ) -> "Session":
        """The session of some wearers, each with a seed from `seed` on; `source`: recording, scan and objects that belong
        to the place, for systems that use them. Raises WearcapError as the system's own constructor does."""
        return cls(system, wearers)

    @classmethod
    def of_objects(cls, system: Any, source: CaptureInput) -> list[ActiveObject | ObjectSample]:
        """The samples of objects, in order of time, that a capture of a whole recording corresponds to.

        Raises WearcapError as that capture does.
        """
        return []

    @classmethod
    def of_piece(cls, system: Any, piece: Recording, folder: Path, refused: Counter[str] | None) -> SuitPiece | None:
        """The sample of a piece of a recording that grows in a folder; None for one that cannot be used, which is counted
        in `refused`. Raises WearcapError for a system that follows none, and without `refused` for such a piece."""
        raise WearcapError("this pipeline cannot follow a growing recording", expected="pipeline=hps")

    @property
    def fps(self) -> float:
        """Frame rate of the poses (Hz)."""
        return self.system.fps

    @property
    def dropped(self) -> list[int]:
        """Number of each wearer's head poses that were late, duplicated or refused."""
        return [stream.dropped for stream in self.streams]

    @property
    def refused(self) -> list[dict[str, int]]:
        """Number of each wearer's refused samples, or parts of samples, by reason ("head: not a rotation")."""
        return [stream.refused for stream in self.streams]

    def push(self, samples: Sequence[Sequence[Any]]) -> None:
        """Take in each wearer's new samples (`sensors.samples`), any number of them.

        Raises WearcapError for samples of another number of wearers.
        """
        if len(samples) != len(self.streams):
            expected = f"of {len(self.streams)}, as the session has"
            raise WearcapError(f"samples of {len(samples)} wearers", expected=expected)
        for stream, part in zip(self.streams, samples):
            for sample in part:
                stream.take(sample)

    def poses(self, ended: bool = False) -> list[Motion | None]:
        """Each wearer's frames that became final since the last call; `ended`: no more samples will come.

        After a wearer's clock was set back, the frames before that come first, and the next call returns those after
        it.
        """
        return [stream.poses(ended) for stream in self.streams]


class HeadStream(ABC):
    """The streaming capture of one wearer, whose clock is that of a head device.

    Invalid packets (`sensors.packets`) are counted as `refused`. If the head device's clock is set back for good, the
    capture restarts like a new session.
    """

    def __init__(self, pipeline: Any, wearer: Wearer, stride: int, anchored: bool):
        """`stride`: frames of a chunk of the head's path; `anchored`: whether the head joint is put where it is measured."""
        self.pipeline, self.wearer, self._anchored = pipeline, wearer, anchored
        self._head_input, self._track = HeadInput(), HeadTrack(pipeline.fps, stride)
        self.finished: list[Motion] = []
        """Final motions with times of a previous clock, not returned yet."""

    @property
    def dropped(self) -> int:
        """Number of head poses that were late, duplicated or refused."""
        return self._track.dropped + self._head_input.dropped

    @property
    def refused(self) -> dict[str, int]:
        """Number of refused samples, or parts of samples, by reason ("head: not a rotation")."""
        return dict(self._head_input.refused)

    @abstractmethod
    def take(self, sample: Any) -> None:
        """Take in one sample (`sensors.samples`)."""

    def _admit(self, sample: HeadSample) -> None:
        """Check one time step of the head device, and take in what its clock accepts now."""
        if not self._head_input.timely(sample.timestamp):
            return
        admitted = self._head_input.admit(float(sample.timestamp), self._checked(sample))
        if admitted.begins:
            if admitted.again and (motion := self._final(ended=True)) is not None:
                self.finished.append(motion)
            self._restart(admitted)
        for _, accepted in admitted.packets:
            self._accept(accepted)

    def _checked(self, sample: HeadSample) -> HeadSample:
        """Copies of the sample's valid parts."""
        head = self._head_input
        return HeadSample(float(sample.timestamp), head.pose(sample.T_world_device), head.points(sample.points_world))

    def _accept(self, sample: HeadSample) -> None:
        """Take in a checked sample."""
        self._track.take(sample.timestamp, sample.T_world_device)

    def _restart(self, admitted: Admitted) -> None:
        """Restart the capture with these packets, perhaps on another clock; counters are kept."""
        dropped = self._track.dropped
        self._track = HeadTrack(self._track.fps, self._track.stride)
        self._track.dropped = dropped
        self._begin()

    def _begin(self) -> None:
        """Begin the capture, as a new one does."""
        self.windows: Any = None
        """Windows of the present stretch; None: none has begun."""
        self._refiner: Refiner | None = None
        """Refines the present stretch."""
        self._motions: list[Motion] = []
        """Final frames that were not returned yet."""

    @abstractmethod
    def _opened(self, chunk: Chunk) -> Any:
        """Windows for the stretch that begins with a chunk; those of the one before are still there."""

    @abstractmethod
    def _sensed(self, chunk: Chunk, ended: bool) -> tuple[Any, ...]:
        """What the windows take in for a chunk; `ended`: no more samples will come."""

    def _push(self, chunk: Chunk, ended: bool) -> None:
        """Give the windows the next chunk; a stretch begins with new ones."""
        if chunk.begins or self.windows is None:
            self.emit(ended=True)
            self.windows = self._opened(chunk)
        elif len(chunk.corrected.t):
            self.windows.correct(self._head_of(chunk.corrected))
        self.windows.push(*self._sensed(chunk, ended))

    def emit(self, ended: bool = False) -> None:
        """Make motion of the frames that the windows put out; `ended`: of all that are left of a stretch."""
        if self.windows is not None:
            self._take(ended)
        if ended and self._refiner is not None:
            self._motions += self._refiner.finish()
            self._refiner = None

    def _take(self, ended: bool) -> None:
        if (final := self.windows.take(ended)) is not None:
            self._refine(self.pipeline.motion(final, self.wearer.skeleton), final.measured)

    def _refine(self, motion: Motion, measured: Measured) -> None:
        """Take in the next frames of a stretch, as the pipeline refines them."""
        if self._refiner is None:
            self._refiner = Refiner(self.pipeline.refinement, motion.skeleton, self.pipeline.fps, self._anchored)
        self._motions += self._refiner.push(motion, measured)

    def _head_of(self, T_world_device: Rigid) -> Rigid:
        """Poses of the head joint, from those of the device on it."""
        return T_world_device @ Rigid(self.wearer.R_head_device, self.wearer.t_head_device).inverse()

    def end(self) -> None:
        """Take in the packets that wait for others, as no more samples will come."""
        for _, accepted in self._head_input.end():
            self._accept(accepted)

    def poses(self, ended: bool = False) -> Motion | None:
        """Frames that became final since the last call, or None; `ended`: no more samples will come.

        After the head device's clock was set back, the frames before come first; call again for the new clock's.
        """
        if ended:
            self.end()
        return self.finished.pop(0) if self.finished else self._final(ended)

    def _final(self, ended: bool) -> Motion | None:
        """Frames on the present clock that became final, or None."""
        self._advance(ended)
        motions, self._motions = self._motions, []
        return joined(motions)

    @abstractmethod
    def _advance(self, ended: bool) -> None:
        """Go on as far as the samples reach."""


class HeadAndWristsStream(HeadStream):
    """The streaming capture of one wearer with a head device and sensors on both wrists, on one clock."""

    def __init__(self, pipeline: Any, wearer: Wearer, stride: int, needs_s: float):
        """`needs_s`: time after a frame until which it needs the wrists' samples."""
        pipeline.prepare()
        super().__init__(pipeline, wearer, stride, pipeline.anchor)
        self._needs_s, self.silent = needs_s, 0
        """Number of frames without samples of a wrist, counted per wrist."""
        self._wrists = WristInput(self._head_input)
        self._chunks: list[Chunk] = []
        """Frames that wait for the wrists."""

    def head(
        self, timestamp: float, T_world_device: Rigid | None, points_world: Float[Tensor, "point 3"] | None = None
    ) -> None:
        """Take in one time step (s) of the head device: its pose (None while tracking is lost) and new points (m)."""
        self._admit(HeadSample(timestamp, T_world_device, points_world))

    def _restart(self, admitted: Admitted) -> None:
        super()._restart(admitted)
        self._wrists.rejoin(None if admitted.again else admitted.packets[0][0])
        self._chunks = []

    def _advance(self, ended: bool) -> None:
        while (chunk := self._track.next(ended)) is not None:
            self._chunks.append(chunk)
        while self._chunks:
            last = self._chunks[0].timestamps[-1].item()
            if not (ended or self._wrists.arrived(last + self._needs_s, last, self._track.newest, MAX_GAP_S)):
                return
            self._push(self._chunks.pop(0), ended)
            self.emit()
        if ended or not self._track.inside:
            self.emit(ended=True)
