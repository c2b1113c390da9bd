"""Score a pipeline on whole recordings, never cut, over several seeds."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Bool
from torch import Tensor

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.metrics.table import Row, evaluate_motion
from wearcap.pipelines.hmd2 import hang_from_head
from wearcap.recording import Motion, Recording, RecordingStore


@runtime_checkable
class Pipeline(Protocol):
    """What every capture system looks like from outside."""

    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]: ...


def evaluate(
    pipeline: Pipeline, store: RecordingStore, names: Iterable[str], seeds: Sequence[int], lanes: int = 16
) -> Iterator[Row]:
    """Capture every recording with every seed, hang the body from the true head, and score it.

    `lanes` recordings share a batch. Raises WearcapError when a recording has no true motion.
    """
    names = sorted(names, key=lambda name: store.entries[name].frames)
    jobs = [(name, seed) for name in names for seed in seeds]
    for start in range(0, len(jobs), lanes):
        batch = jobs[start : start + lanes]
        recordings = {name: store.load(name) for name, _ in batch}
        motions = pipeline.capture([recordings[name] for name, _ in batch], [seed for _, seed in batch])
        for (name, seed), motion in zip(batch, motions):
            yield score(motion, recordings[name], name, seed)


def score(motion: Motion, recording: Recording, name: str, seed: int) -> Row:
    """All metrics of one capture against its recording's truth, both hung from the true head."""
    truth = recording.motion
    if truth is None:
        raise WearcapError("no true motion to compare with", where=name, expected="a recording with `motion`")
    hung = hang_from_head(motion, truth.joint("head"))
    return Row(name, seed, len(truth), evaluate_motion(hung, truth, _foot_contact(recording)))


def _foot_contact(recording: Recording) -> Bool[Tensor, "time patch"] | None:
    """True contact of the foot patches among the parts that a recording tracks (hands may be others)."""
    track = recording.contacts
    if track is None or not set(FOOT_PATCHES) <= set(track.parts):
        return None
    return track.contact[:, [track.parts.index(patch) for patch in FOOT_PATCHES]]
