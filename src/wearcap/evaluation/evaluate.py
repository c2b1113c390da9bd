"""Scores of a system on whole, uncut recordings, over several seeds."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from wearcap.metrics.table import Row
from wearcap.recording import Motion, RecordingStore
from wearcap.runtime.system import CaptureInput, StageOptions, System

Measure = Callable[[Motion, CaptureInput, int], Row]
"""Function that scores a captured motion against its recording, given the seed."""


def evaluate(
    system: System,
    store: RecordingStore,
    names: Iterable[str],
    seeds: Sequence[int],
    batch_size: int = 16,
    measure: Measure | None = None,
    scene: str | Path | None = None,
    metres_per_unit: float | None = None,
    options: StageOptions | None = None,
) -> Iterator[Row]:
    """Capture every recording with every seed and score it.

    `batch_size` recordings share a batch; `measure` replaces `system.score`; `scene` replaces the recordings' own.
    Raises WearcapError when a recording has no true motion.
    """
    names = sorted(names, key=lambda name: store.entries[name].frames)
    jobs = [(name, seed) for name in names for seed in seeds]
    for start in range(0, len(jobs), batch_size):
        batch = jobs[start : start + batch_size]
        recordings = {name: store.load(name) for name, _ in batch}
        sources = {
            name: CaptureInput.in_dataset(recording, store.root, scene, metres_per_unit)
            for name, recording in recordings.items()
        }
        captures = system.capture([sources[name] for name, _ in batch], [seed for _, seed in batch], options)
        for (name, seed), captured in zip(batch, captures):
            if captured.motion is not None:
                yield (measure or system.score)(captured.motion, sources[name], seed)
