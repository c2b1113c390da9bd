"""Streaming HMD²: sensor packets go in as they arrive, poses come out every `stride` frames (thesis eq. 6.5).

Windows, noise and anchoring are those of `HMD2.capture`: with the same seed, and a pipeline that is `live` (its floor
uses earlier data only), the poses are the same. Memory is bounded by a window and the points that are kept.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.runtime.session import Session
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.packets import Admitted, time_fault
from wearcap.sensors.samples import HeadSample
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.wearer import WearerState
from wearcap.systems.hmd2.windows import advance
from wearcap.tracking.head_path import Chunk


class HMD2Session(Session):
    """A streaming capture of one or several wearers with one pipeline, whose windows share batches.

    Poses are final once `stride` frames, and `lookahead_frames` and those of the refinement after them, have arrived;
    poses pending at a gap are returned with the next ones. Samples may be late or out of order within those frames; poses that are later still
    count as `dropped` (their points and embeddings are used). A missing or refused head pose is interpolated; at a
    chunk's end, before a newer one has arrived, the last pose is repeated, and corrected for the windows that follow.
    After a gap or jump (`tracking.head_path.MAX_GAP_S`, `MAX_SPEED_M_S`) the capture restarts; gaps get no poses.
    When a wearer's clock is reset, that wearer's capture restarts as in a new session.
    """

    def __init__(self, pipeline: HMD2, wearers: Sequence[Wearer], seeds: Sequence[int], memory: Memory | None = None):
        """Raises WearcapError when there is not one seed per wearer, or for a stride or lookahead that does not fit."""
        if len(wearers) != len(seeds) or not wearers:
            raise WearcapError(f"{len(seeds)} seeds for {len(wearers)} wearers", expected="one for each wearer")
        pipeline.prepare()
        memory = memory or Memory()
        super().__init__(pipeline, [WearerState(pipeline, who, seed, memory) for who, seed in zip(wearers, seeds)])
        self.embedded = False
        """Whether an embedding of the right length has arrived."""

    @classmethod
    def of_wearers(
        cls, system: HMD2, wearers: Sequence[Wearer], seed: int = 0, source: CaptureInput | None = None
    ) -> "HMD2Session":
        return cls(system, wearers, range(seed, seed + len(wearers)))

    def push(self, samples: Sequence[Sequence[HeadSample]]) -> None:
        """Take in each wearer's new samples, any number of them.

        Raises WearcapError for samples of another number of wearers and, without taking anything in, for an embedding
        of another length than the network's as long as none of the right length has arrived; later ones are refused.
        """
        if len(samples) != len(self.streams):
            expected = f"of {len(self.streams)}, as the session has"
            raise WearcapError(f"samples of {len(samples)} wearers", expected=expected)
        wearers = zip(self.streams, samples) if not self.embedded else ()
        for sample in (sample for state, part in wearers if state.shows_pictures for sample in part):
            embedding, size = getattr(sample, "embedding", None), self.system.model.net.image_size
            if isinstance(embedding, Tensor) and embedding.shape == (size,):
                self.embedded = True
                break
            if isinstance(embedding, Tensor) and embedding.ndim == 1:
                when = "an unknown time" if time_fault(sample.timestamp) else f"{sample.timestamp:.3f} s"
                expected = f"{size} of {self.system.model.image_encoder!r}, which the network was trained on"
                raise WearcapError(f"an embedding of {len(embedding)} features at {when}", expected=expected)
        for number, part in enumerate(samples):
            for sample in part:
                self._take(number, self.streams[number].admit(sample))

    def poses(self, ended: bool = False) -> list[Motion | None]:
        begun = [number for number, state in enumerate(self.streams) if state.finished]
        others = [number for number in range(len(self.streams)) if number not in begun]
        for number in others if ended else ():
            for _, sample in self.streams[number].door.end():
                self.streams[number].take(sample)
        motions = self._run(others, ended)
        for number in begun:
            motions[number] = joined(self.streams[number].finished)
            self.streams[number].finished = []
        return motions

    def _take(self, number: int, admitted: Admitted) -> None:
        """Process one wearer's accepted samples; at a reset of the clock the remaining poses are finished."""
        state = self.streams[number]
        if admitted.begins:
            if admitted.again and (last := self._run([number], ended=True)[number]) is not None:
                state.finished.append(last)
            state.begin()
        for _, sample in admitted.packets:
            state.take(sample)

    def _run(self, wearers: Sequence[int], ended: bool) -> list[Motion | None]:
        """The next poses of some wearers; None for the others."""
        predicted: list[list[Motion]] = [[] for _ in self.streams]
        while chunks := {i: chunk for i in wearers if (chunk := self.streams[i].track.next(ended))}:
            for i, chunk in chunks.items():
                if chunk.begins:
                    predicted[i] += self.streams[i].end()
            with self.system.undisturbed():
                self._advance(chunks)
            for i in chunks:
                predicted[i] += self.streams[i].finalize(self.system.lookahead_frames)
        for i in wearers if ended else ():
            predicted[i] += self.streams[i].end()
        return [joined(parts) for parts in predicted]

    @torch.inference_mode()
    def _advance(self, chunks: dict[int, Chunk]) -> None:
        """Sample the next chunk of some wearers, in one batch."""
        samplers, fresh = [], []
        for i, chunk in chunks.items():
            state = self.streams[i]
            T_device_head = Rigid(state.wearer.R_head_device, state.wearer.t_head_device).inverse()
            fresh.append(state.frames(chunk, chunk.T_world_device @ T_device_head))
            state.times = torch.cat([state.times, chunk.timestamps])
            if chunk.begins or state.sampler is None:
                state.sampler = self.system.sampler(state.wearer.skeleton, state.seed, chunk.first)
            elif len(chunk.corrected.t):
                state.sampler.correct(chunk.corrected @ T_device_head)
            samplers.append(state.sampler)
        advance(samplers, fresh)


SESSION = HMD2Session
