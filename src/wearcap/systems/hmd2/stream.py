"""HMD² while things happen: moments go in as they come, poses come out every `stride` frames (thesis eq. 6.5).

Windows, noise and hanging are those of `HMD2.capture`: with the same seed, and a pipeline that is `live` (its floor is
what had been seen by then), the poses are the same. Memory is that of a window and of the points that are kept.
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
    """A streaming capture of one or several wearers with one pipeline; each has a clock of their own.

    Poses wait until `stride` frames, and the `lookahead_frames` ones behind them, have come; what waits at a gap is given with what
    comes behind it. Moments may come late or out of order within those frames; later ones
    count as `dropped` (their points and pictures still serve). A pose that is missing or refused is interpolated;
    at a chunk's end, where no newer one is known yet, the last is held, and put right for the windows that follow.
    After a gap or jump (`hmd2.MAX_GAP_S`, `MAX_SPEED_M_S`) the capture begins anew, and nothing is said of the gap.
    What cannot be true (`sensors.packets`) is `refused`, and concerns nobody else. Where a wearer's clock goes back
    for good, that wearer's capture begins anew as a new session would.
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
        self.pipeline, self.memory, self._lookahead_frames = (
            pipeline,
            memory or Memory(),
            pipeline.lookahead_frames,
        )
        self._items = [
            WearerState(pipeline, wearer, seed, self.memory) for wearer, seed in zip(wearers, seeds)
        ]
        self._embedded = False
        """Whether an embedding of the right length has come."""

    @property
    def dropped(self) -> list[int]:
        """Poses of each wearer that came too late, twice, or were refused."""
        return [item.dropped for item in self._items]

    @property
    def refused(self) -> list[dict[str, int]]:
        """How many packets, or parts of them, of each wearer were refused, by reason: "head: not a rotation"."""
        return [dict(item.door.refused) for item in self._items]

    def push(self, sensed: Sequence[Sequence[Sensed]]) -> list[Motion | None]:
        """Take in each wearer's new moments (any number, also none); poses of each whose next frames are complete.

        Where a clock has gone back these are the poses before; those with the new times come with the next push.
        Raises WearcapError, and takes nothing in, for embeddings of another length than the network knows where none
        of the right length has come yet; later ones are refused.
        """
        if len(sensed) != len(self._items):
            raise WearcapError(f"moments of {len(sensed)} wearers", expected=f"of {len(self._items)}, as the session has")  # fmt: skip
        if not self._embedded:
            self._require_embeddings(sensed)
        before: dict[int, list[Motion]] = {}
        for i, moments in enumerate(sensed):
            for moment in moments:
                before.setdefault(i, []).extend(self._take(i, self._items[i].admit(moment)))
        begun = {i for i, parts in before.items() if parts}
        predicted = self._run([i for i in range(len(self._items)) if i not in begun], ended=False)
        return [joined(before[i]) if i in begun else motion for i, motion in enumerate(predicted)]

    def flush(self) -> list[Motion | None]:
        """Poses of the frames that still wait, when nothing more will come."""
        for item in self._items:
            for _, moment in item.door.end():
                item.take(moment)
        return self._run(range(len(self._items)), ended=True)

    def _take(self, number: int, admitted: Admitted) -> list[Motion]:
        """Take in one wearer's moments; the poses left from before, where the clock begins anew with them."""
        item, left = self._items[number], []
        if admitted.begins:
            last = self._run([number], ended=True)[number] if admitted.again else None
            left = [] if last is None else [last]
            item.begin()
        for _, moment in admitted.packets:
            item.take(moment)
        return left

    def _require_embeddings(self, sensed: Sequence[Sequence[Sensed]]) -> None:
        size = self.pipeline.net.image_size
        for item, moments in zip(self._items, sensed):
            for moment in moments:
                embedding = getattr(moment, "embedding", None)
                if not item.shows_pictures or not isinstance(embedding, Tensor) or embedding.ndim != 1:
                    continue
                if embedding.shape == (size,):
                    self._embedded = True
                    return
                raise WearcapError(f"an embedding of {len(embedding)} features at {_time(moment)}",
                                   expected=f"{size} of {self.pipeline.image_encoder!r}, which the network was trained on")  # fmt: skip

    def _run(self, wearers: Sequence[int], ended: bool) -> list[Motion | None]:
        """The next poses of some wearers; None for the others."""
        predicted: list[list[Motion]] = [[] for _ in self._items]
        while chunks := {i: chunk for i in wearers if (chunk := self._items[i].track.next(ended))}:
            for i, chunk in chunks.items():
                if chunk.begins:
                    predicted[i] += self._items[i].give(0)
            with self.pipeline.undisturbed():
                self._advance(chunks)
            for i in chunks:
                predicted[i] += self._items[i].give(self._lookahead_frames)
        for i in wearers if ended else ():
            predicted[i] += self._items[i].give(0)
        return [joined(parts) for parts in predicted]

    @torch.inference_mode()
    def _advance(self, chunks: dict[int, Chunk]) -> None:
        """Say one chunk of some wearers, in one batch."""
        samplers, fresh = [], []
        for i, chunk in chunks.items():
            item = self._items[i]
            T_device_head = Rigid(item.wearer.R_head_device, item.wearer.t_head_device).inverse()
            fresh.append(item.frames(chunk, chunk.T_world_device @ T_device_head))
            item.times = torch.cat([item.times, chunk.timestamps])
            if chunk.begins or item.sampler is None:
                item.sampler = self.pipeline.sampler(item.wearer.skeleton, item.seed, chunk.first)
            elif len(chunk.corrected.t):
                item.sampler.correct(chunk.corrected @ T_device_head)
            samplers.append(item.sampler)
        advance(samplers, fresh)

    def save(self, path: str | Path) -> None:
        """Write everything that the poses to come depend on, but the pipeline (.safetensors)."""
        write(path, self.pipeline, self._items, self._embedded)

    @classmethod
    def load(cls, path: str | Path, pipeline: HMD2) -> "Session":
        """The session that was saved, with the pipeline that it ran with.

        Raises WearcapError for a file that is no session's or is damaged, and for a pipeline with other settings.
        """
        saved = read(path, pipeline)
        wearers, seeds = zip(*((state.wearer, state.seed) for state in saved.wearers))
        session = cls(pipeline, wearers, seeds, saved.memory)
        session._items, session._embedded = saved.wearers, saved.embedded
        return session


def _time(sensed: Sensed) -> str:
    return "an unknown time" if time_fault(sensed.timestamp) else f"{sensed.timestamp:.3f} s"
