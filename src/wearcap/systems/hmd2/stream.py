"""Streaming HMD²: sensor packets go in as they arrive, poses come out every `stride` frames (thesis eq. 6.5).

Windows, noise and anchoring are those of `HMD2.capture`: with the same seed, and a pipeline that is `live` (its floor
uses earlier data only), the poses are the same. Memory is bounded by a window and the points that are kept.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.sensors.packets import Admitted, time_fault
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.saved import read, write
from wearcap.systems.hmd2.wearer import Sensed, Wearer, WearerState
from wearcap.systems.hmd2.windows import advance
from wearcap.tracking.head_track import Chunk

__all__ = ["Sensed", "Session", "Wearer", "joined"]


class Session:
    """A streaming capture of one or several wearers with one pipeline; every wearer has their own clock.

    Poses are output once `stride` frames, and `lookahead_frames` after them, have arrived; poses pending at a gap are
    output with the next ones. Packets may be late or out of order within those frames; poses that are later still count
    as `dropped` (their points and embeddings are used). A missing or refused head pose is interpolated; at a chunk's
    end, before a newer one has arrived, the last pose is repeated, and corrected for the windows that follow.
    After a gap or jump (`tracking.head_path.MAX_GAP_S`, `MAX_SPEED_M_S`) the capture restarts; gaps get no poses.
    Implausible values (`sensors.packets`) are `refused` without affecting other wearers. When a wearer's clock is
    reset, that wearer's capture restarts as in a new session.
    """

    def __init__(self, pipeline: HMD2, wearers: Sequence[Wearer], seeds: Sequence[int], memory: Memory | None = None):
        """Raises WearcapError when there is not one seed per wearer, or for a stride or lookahead that does not fit."""
        if len(wearers) != len(seeds) or not wearers:
            raise WearcapError(f"{len(seeds)} seeds for {len(wearers)} wearers", expected="one for each wearer")
        pipeline.prepare()
        self.pipeline, self.memory, self._lookahead_frames = (pipeline, memory or Memory(), pipeline.lookahead_frames)
        self._wearers = [WearerState(pipeline, wearer, seed, self.memory) for wearer, seed in zip(wearers, seeds)]
        self._embedded = False
        """Whether an embedding of the right length has arrived."""

    @property
    def dropped(self) -> list[int]:
        """Number of each wearer's poses that were late, duplicated or refused."""
        return [state.dropped for state in self._wearers]

    @property
    def refused(self) -> list[dict[str, int]]:
        """Number of each wearer's refused packets, or parts of packets, by reason ("head: not a rotation")."""
        return [dict(state.door.refused) for state in self._wearers]

    def push(self, sensed: Sequence[Sequence[Sensed]]) -> list[Motion | None]:
        """Process each wearer's new packets (any number, also none); returns each wearer's newly final poses or None.

        When a clock was reset, these are the poses before the reset; poses at the new times follow with the next push.
        Raises WearcapError, without processing anything, for an embedding of another length than the network's as long
        as none of the right length has arrived; later ones are refused.
        """
        if len(sensed) != len(self._wearers):
            raise WearcapError(
                f"packets of {len(sensed)} wearers", expected=f"of {len(self._wearers)}, as the session has"
            )
        if not self._embedded:
            self._require_embeddings(sensed)
        before: dict[int, list[Motion]] = {}
        for i, moments in enumerate(sensed):
            for moment in moments:
                before.setdefault(i, []).extend(self._take(i, self._wearers[i].admit(moment)))
        begun = {i for i, parts in before.items() if parts}
        predicted = self._run([i for i in range(len(self._wearers)) if i not in begun], ended=False)
        return [joined(before[i]) if i in begun else motion for i, motion in enumerate(predicted)]

    def flush(self) -> list[Motion | None]:
        """Poses of all remaining frames, at the end of the stream."""
        for state in self._wearers:
            for _, moment in state.door.end():
                state.take(moment)
        return self._run(range(len(self._wearers)), ended=True)

    def _take(self, number: int, admitted: Admitted) -> list[Motion]:
        """Process one wearer's accepted packets; returns the poses that remained before a reset of the clock."""
        state, left = self._wearers[number], []
        if admitted.begins:
            last = self._run([number], ended=True)[number] if admitted.again else None
            left = [] if last is None else [last]
            state.begin()
        for _, moment in admitted.packets:
            state.take(moment)
        return left

    def _require_embeddings(self, sensed: Sequence[Sequence[Sensed]]) -> None:
        size = self.pipeline.net.image_size
        for state, moments in zip(self._wearers, sensed):
            for moment in moments:
                embedding = getattr(moment, "embedding", None)
                if not state.shows_pictures or not isinstance(embedding, Tensor) or embedding.ndim != 1:
                    continue
                if embedding.shape == (size,):
                    self._embedded = True
                    return
                raise WearcapError(
                    f"an embedding of {len(embedding)} features at {_time(moment)}",
                    expected=f"{size} of {self.pipeline.image_encoder!r}, which the network was trained on",
                )

    def _run(self, wearers: Sequence[int], ended: bool) -> list[Motion | None]:
        """The next poses of some wearers; None for the others."""
        predicted: list[list[Motion]] = [[] for _ in self._wearers]
        while chunks := {i: chunk for i in wearers if (chunk := self._wearers[i].track.next(ended))}:
            for i, chunk in chunks.items():
                if chunk.begins:
                    predicted[i] += self._wearers[i].finalize(0)
            with self.pipeline.undisturbed():
                self._advance(chunks)
            for i in chunks:
                predicted[i] += self._wearers[i].finalize(self._lookahead_frames)
        for i in wearers if ended else ():
            predicted[i] += self._wearers[i].finalize(0)
        return [joined(parts) for parts in predicted]

    @torch.inference_mode()
    def _advance(self, chunks: dict[int, Chunk]) -> None:
        """Sample the next chunk of some wearers, in one batch."""
        samplers, fresh = [], []
        for i, chunk in chunks.items():
            state = self._wearers[i]
            T_device_head = Rigid(state.wearer.R_head_device, state.wearer.t_head_device).inverse()
            fresh.append(state.frames(chunk, chunk.T_world_device @ T_device_head))
            state.times = torch.cat([state.times, chunk.timestamps])
            if chunk.begins or state.sampler is None:
                state.sampler = self.pipeline.sampler(state.wearer.skeleton, state.seed, chunk.first)
            elif len(chunk.corrected.t):
                state.sampler.correct(chunk.corrected @ T_device_head)
            samplers.append(state.sampler)
        advance(samplers, fresh)

    def save(self, path: str | Path) -> None:
        """Write everything that future poses depend on, except the pipeline (.safetensors)."""
        write(path, self.pipeline, self._wearers, self._embedded)

    @classmethod
    def load(cls, path: str | Path, pipeline: HMD2) -> "Session":
        """Restore a saved session with the pipeline that it ran with.

        Raises WearcapError for a file that is no session or is damaged, and for a pipeline with other settings.
        """
        saved = read(path, pipeline)
        wearers, seeds = zip(*((state.wearer, state.seed) for state in saved.wearers))
        session = cls(pipeline, wearers, seeds, saved.memory)
        session._wearers, session._embedded = saved.wearers, saved.embedded
        return session


def _time(sensed: Sensed) -> str:
    return "an unknown time" if time_fault(sensed.timestamp) else f"{sensed.timestamp:.3f} s"
