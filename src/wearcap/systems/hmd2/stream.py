"""Streaming HMD²: sensor packets go in as they arrive, poses come out every `stride` frames (thesis eq. 6.5).

Sensing, windows, noise and anchoring are those of `HMD2.capture`: with the same seed, and a pipeline that is `live` (its
floor uses earlier data only), the poses are the same. Memory is bounded by a window and the points that are kept.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.recording import Motion
from wearcap.runtime.session import HeadStream, Session
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors import packets
from wearcap.sensors.packets import Admitted, WristInput, time_fault
from wearcap.sensors.samples import HeadSample, WristSample
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.sensing import Sensing
from wearcap.systems.hmd2.windows import Frames, WindowSampler
from wearcap.tracking.head_path import Chunk


class HMD2Stream(HeadStream):
    """One wearer of a session: checked packets that are not used yet, map, and windows."""

    def __init__(self, pipeline: HMD2, wearer: Wearer, seed: int, memory: Memory):
        super().__init__(pipeline, wearer, pipeline.advance, anchored=True)
        self._wrists = WristInput(self._head_input)
        self.seed, self.memory = seed, memory
        self._begin()

    def _begin(self) -> None:
        super()._begin()
        pipeline, stature = self.pipeline, self.wearer.skeleton.height_of("head")
        self.sensing = Sensing(pipeline.model, pipeline.used, stature, self.memory)

    def take(self, sample: Any) -> None:
        """Take in one sample of the head device, or a wrist's pose, which a network without hands does not use."""
        match sample:
            case HeadSample():
                self._admit(sample)
            case WristSample() if sample.joint in WRISTS:
                self._wrists.add_pose(*sample)
            case _:
                self._head_input.refuse("head", packets.WRONG_TYPE)

    def _restart(self, admitted: Admitted) -> None:
        super()._restart(admitted)
        self._wrists.rejoin(None if admitted.again else admitted.packets[0][0])

    def _checked(self, sample: HeadSample) -> HeadSample:
        head, fields = self._head_input, {condition.field: condition for condition in self.sensing.used.values()}
        parts = {name: fields[name].checked(getattr(sample, name), head) for name in fields if hasattr(sample, name)}
        floor_m = sample.floor_height
        if floor_m is not None and (fault := packets.number_fault(floor_m, packets.MAX_POSITION_M)):
            head.refuse("floor height", fault)
            floor_m = None
        floor_m = None if floor_m is None else float(floor_m)
        return HeadSample(float(sample.timestamp), head.pose(sample.T_world_device), floor_height=floor_m, **parts)

    def _accept(self, sample: HeadSample) -> None:
        super()._accept(sample)
        self.sensing.take(sample)

    def _opened(self, chunk: Chunk) -> WindowSampler:
        return self.pipeline.sampler(self.wearer.skeleton, self.seed, chunk.first)

    def _sensed(self, chunk: Chunk, ended: bool) -> tuple[Frames]:
        T_world_head = self._head_of(chunk.T_world_device)
        if (hands := self.sensing.sensed.get("hands")) is not None:
            found = {joint: self._wrists.track(joint, chunk.timestamps[0].item()) for joint in WRISTS}
            hands.tracked.update({joint: track for joint, track in found.items() if track is not None})
        return (self.sensing.frames(chunk.timestamps, chunk.T_world_device, T_world_head),)

    def sense(self, ended: bool) -> bool:
        """Give the windows the next chunk of the head's path; False: it is not complete."""
        chunk = self._track.next(ended)
        if chunk is not None:
            self._push(chunk, ended)
        return chunk is not None

    def _advance(self, ended: bool) -> None:
        advance([self], ended)


@torch.inference_mode()
def advance(streams: Sequence[HMD2Stream], ended: bool) -> None:
    """Predict all frames whose chunks are complete; wearers share batches."""
    while ready := [stream for stream in streams if stream.sense(ended)]:
        pipeline = streams[0].pipeline
        with pipeline.undisturbed():
            pipeline.predict([stream.windows for stream in ready])
        for stream in ready:
            stream.emit()
    for stream in streams if ended else ():
        stream.emit(ended=True)


class HMD2Session(Session):
    """A streaming capture of one or several wearers with one pipeline, whose windows share batches.

    Poses are final once `stride` frames, and `lookahead_frames` and those of the refinement after them, have arrived;
    poses pending at a gap are returned with the next ones. Samples may be late or out of order within those frames; poses that are later still
    count as `dropped` (their points and embeddings are used). A missing or refused head pose is interpolated; at a
    chunk's end, before a newer one has arrived, the last pose is repeated, and corrected for the windows that follow.
    After a gap or jump (`tracking.head_path.MAX_GAP_S`, `MAX_SPEED_M_S`) the capture restarts; gaps get no poses.
    When a wearer's clock is reset, that wearer's capture restarts as in a new session.
    """

    optional = WRISTS
    tracks_wrists = True

    def __init__(self, pipeline: HMD2, wearers: Sequence[Wearer], seeds: Sequence[int], memory: Memory | None = None):
        """Raises WearcapError when there is not one seed per wearer, or for a stride or lookahead that does not fit."""
        if len(wearers) != len(seeds) or not wearers:
            raise WearcapError(f"{len(seeds)} seeds for {len(wearers)} wearers", expected="one for each wearer")
        pipeline.prepare()
        memory = memory or Memory()
        super().__init__(pipeline, [HMD2Stream(pipeline, who, seed, memory) for who, seed in zip(wearers, seeds)])
        self.embedded = False
        """Whether an embedding of the right length has arrived."""

    @classmethod
    def of_wearers(
        cls, system: HMD2, wearers: Sequence[Wearer], seed: int = 0, source: CaptureInput | None = None
    ) -> "HMD2Session":
        return cls(system, wearers, range(seed, seed + len(wearers)))

    def push(self, samples: Sequence[Sequence[Any]]) -> None:
        """Take in each wearer's new samples, any number of them.

        Raises WearcapError for samples of another number of wearers and, without taking anything in, for an embedding
        of another length than the network's as long as none of the right length has arrived; later ones are refused.
        """
        wearers = zip(self.streams, samples) if not self.embedded else ()
        for sample in (sample for stream, part in wearers if "image" in stream.sensing.sensed for sample in part):
            embedding, image = getattr(sample, "embedding", None), self.system.model.conditions["image"]
            if isinstance(embedding, Tensor) and embedding.shape == (image.size,):
                self.embedded = True
                break
            if isinstance(embedding, Tensor) and embedding.ndim == 1:
                when = "an unknown time" if time_fault(sample.timestamp) else f"{sample.timestamp:.3f} s"
                expected = f"{image.size} of {image.encoder!r}, which the network was trained on"
                raise WearcapError(f"an embedding of {len(embedding)} features at {when}", expected=expected)
        super().push(samples)

    def poses(self, ended: bool = False) -> list[Motion | None]:
        for stream in self.streams if ended else ():
            stream.end()
        advance([stream for stream in self.streams if not stream.finished], ended)
        return super().poses(ended)


SESSION = HMD2Session
