"""Scores of a pipeline on whole, uncut recordings, over several seeds."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol, runtime_checkable

from wearcap.metrics.scores import Measure, score
from wearcap.metrics.table import Row
from wearcap.recording import Motion, Recording, RecordingStore


@runtime_checkable
class Pipeline(Protocol):
    """The interface of every capture system."""

    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]: ...


def evaluate(
    pipeline: Pipeline,
    store: RecordingStore,
    names: Iterable[str],
    seeds: Sequence[int],
    batch_size: int = 16,
    measure: Measure | None = None,
) -> Iterator[Row]:
    """Capture every recording with every seed, anchor the body to the true head, and score it.

    `batch_size` recordings share a batch; `measure` replaces `score`. Raises WearcapError when a recording has no true
    motion.
    """
    names = sorted(names, key=lambda name: store.entries[name].frames)
    jobs = [(name, seed) for name in names for seed in seeds]
    for start in range(0, len(jobs), batch_size):
        batch = jobs[start : start + batch_size]
        recordings = {name: store.load(name) for name, _ in batch}
        motions = pipeline.capture([recordings[name] for name, _ in batch], [seed for _, seed in batch])
        for (name, seed), motion in zip(batch, motions):
            yield (measure or score)(motion, recordings[name], name, seed)
