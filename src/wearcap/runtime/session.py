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
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.packets import Admitted, HeadInput, WristInput
from wearcap.sensors.samples import ActiveObject, ObjectSample, SuitPiece
from wearcap.tracking.head_path import Chunk, HeadTrack


class Session:
    """A streaming capture of one or several wearers with one system; every wearer has their own clock.

    Implausible samples (`sensors.packets`) are refused and counted, and never affect other wearers.
    """

    devices: ClassVar[tuple[str, ...]] = ("head",)
    """Devices of a wearer without which there is no motion: "head", joints of wrists, "suit", "camera"."""
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


class HeadAndWristsStream(ABC):
    """The streaming capture of one wearer with a head device and sensors on both wrists, on one clock.

    Invalid packets (`sensors.packets`) are counted as `refused`. If the head device's clock is set back for good, the
    capture restarts like a new session.
    """

    def __init__(self, pipeline: Any, fps: float, stride: int):
        """`fps`: frame rate of the poses (Hz); `stride`: frames of a chunk of the head's path."""
        pipeline.prepare()
        self.pipeline = pipeline
        self.silent = 0
        """Number of frames without samples of a wrist, counted per wrist."""
        self._head_input, self._track = HeadInput(), HeadTrack(fps, stride)
        self._wrists = WristInput(self._head_input)
        self._finished: list[Motion] = []
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

    def head(
        self, timestamp: float, T_world_device: Rigid | None, points_world: Float[Tensor, "point 3"] | None = None
    ) -> None:
        """Take in one time step (s) of the head device: its pose (None while tracking is lost) and new points (m)."""
        if self._head_input.timely(timestamp):
            packet = self._head_input.pose(T_world_device), self._head_input.points(points_world)
            self._take(self._head_input.admit(float(timestamp), packet))

    def _take(self, admitted: Admitted) -> None:
        if admitted.begins:
            if admitted.again and (motion := self._final(ended=True)) is not None:
                self._finished.append(motion)
            self._restart(admitted.again)
            self._wrists.rejoin(None if admitted.again else admitted.packets[0][0])
        for time, (pose, _) in admitted.packets:
            self._track.take(time, pose)

    def _restart(self, again: bool = False) -> None:
        """Restart the capture, with `again` on another clock; wrist samples and counters are kept."""
        dropped = self._track.dropped
        self._track = HeadTrack(self._track.fps, self._track.stride)
        self._track.dropped = dropped
        self._chunks: list[Chunk] = []

    def poses(self, ended: bool = False) -> Motion | None:
        """Frames that became final since the last call, or None; `ended`: no more samples will come.

        After the head device's clock was set back, the frames before come first; call again for the new clock's.
        """
        if ended:
            for time, (pose, _) in self._head_input.end():
                self._track.take(time, pose)
        return self._finished.pop(0) if self._finished else self._final(ended)

    @abstractmethod
    def _final(self, ended: bool) -> Motion | None:
        """Frames on the present clock that became final, or None."""
