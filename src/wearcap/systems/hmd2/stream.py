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

    Poses wait until `stride` frames, and the `waiting` ones behind them, have come; what waits at a gap is given with what
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
        self.pipeline, self.memory, self._waiting = pipeline, memory or Memory(), pipeline.waiting
        self._lanes = [
            WearerState(pipeline, wearer, seed, self.memory) for wearer, seed in zip(wearers, seeds)
        ]
        self._embedded = False
        """Whether an embedding of the right length has come."""

    @property
    def dropped(self) -> list[int]:
        """Poses of each wearer that came too late, twice, or were refused."""
        return [lane.dropped for lane in self._lanes]

    @property
    def refused(self) -> list[dict[str, int]]:
        """How many packets, or parts of them, of each wearer were refused, by reason: "head: not a rotation"."""
        return [dict(lane.door.refused) for lane in self._lanes]

    def push(self, sensed: Sequence[Sequence[Sensed]]) -> list[Motion | None]:
        """Take in each wearer's new moments (any number, also none); poses of each whose next frames are complete.

        Where a clock has gone back these are the poses before; those with the new times come with the next push.
        Raises WearcapError, and takes nothing in, for embeddings of another length than the network knows where none
        of the right length has come yet; later ones are refused.
        """
        if len(sensed) != len(self._lanes):
            raise WearcapError(f"moments of {len(sensed)} wearers", expected=f"of {len(self._lanes)}, as the session has")  # fmt: skip
        if not self._embedded:
            self._require_embeddings(sensed)
        before: dict[int, list[Motion]] = {}
        for i, moments in enumerate(sensed):
            for moment in moments:
                before.setdefault(i, []).extend(self._take(i, self._lanes[i].admit(moment)))
        begun = {i for i, parts in before.items() if parts}
        said = self._run([i for i in range(len(self._lanes)) if i not in begun], ended=False)
        return [joined(before[i]) if i in begun else motion for i, motion in enumerate(said)]

    def flush(self) -> list[Motion | None]:
        """Poses of the frames that still wait, when nothing more will come."""
        for lane in self._lanes:
            for _, moment in lane.door.end():
                lane.take(moment)
        return self._run(range(len(self._lanes)), ended=True)

    def _take(self, number: int, admitted: Admitted) -> list[Motion]:
        """Take in one wearer's moments; the poses left from before, where the clock begins anew with them."""
        lane, left = self._lanes[number], []
        if admitted.begins:
            last = self._run([number], ended=True)[number] if admitted.again else None
            left = [] if last is None else [last]
            lane.begin()
        for _, moment in admitted.packets:
            lane.take(moment)
        return left

    def _require_embeddings(self, sensed: Sequence[Sequence[Sensed]]) -> None:
        size = self.pipeline.net.image_size
        for lane, moments in zip(self._lanes, sensed):
            for moment in moments:
                embedding = getattr(moment, "embedding", None)
                if not lane.shows_pictures or not isinstance(embedding, Tensor) or embedding.ndim != 1:
                    continue
                if embedding.shape == (size,):
                    self._embedded = True
                    return
                raise WearcapError(f"an embedding of {len(embedding)} features at {_time(moment)}",
                                   expected=f"{size} of {self.pipeline.image_encoder!r}, which the network was trained on")  # fmt: skip

    def _run(self, wearers: Sequence[int], ended: bool) -> list[Motion | None]:
        """The next poses of some wearers; None for the others."""
        said: list[list[Motion]] = [[] for _ in self._lanes]
        while chunks := {i: chunk for i in wearers if (chunk := self._lanes[i].track.next(ended))}:
            for i, chunk in chunks.items():
                if chunk.begins:
                    said[i] += self._lanes[i].give(0)
            with self.pipeline.undisturbed():
                self._advance(chunks)
            for i in chunks:
                said[i] += self._lanes[i].give(self._waiting)
        for i in wearers if ended else ():
            said[i] += self._lanes[i].give(0)
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
        write(path, self.pipeline, self._lanes, self._embedded)

    @classmethod
    def load(cls, path: str | Path, pipeline: HMD2) -> "Session":
        """The session that was saved, with the pipeline that it ran with.

        Raises WearcapError for a file that is no session's or is damaged, and for a pipeline with other settings.
        """
        saved = read(path, pipeline)
        wearers, seeds = zip(*((state.wearer, state.seed) for state in saved.wearers))
        session = cls(pipeline, wearers, seeds, saved.memory)
        session._lanes, session._embedded = saved.wearers, saved.embedded
        return session


def _time(sensed: Sensed) -> str:
    return "an unknown time" if time_fault(sensed.timestamp) else f"{sensed.timestamp:.3f} s"
