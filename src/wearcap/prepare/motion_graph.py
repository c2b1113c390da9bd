"""New recordings out of prepared ones: walks through a graph of their motion (`data.motion_graph`)."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path

from wearcap.data import motion_graph
from wearcap.data.motion_graph import MotionGraph, WalkSettings
from wearcap.errors import WearcapError
from wearcap.prepare.engine import Report, Task, content_hash, prepare
from wearcap.prepare.mocap import About, MocapSettings, mocap_recording
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingStore

SPLIT = "train"
"""The split whose recordings are joined, and which the new ones belong to."""


def motion_graph_dataset(
    sources: Sequence[str | Path],
    output: str | Path,
    recordings: int,
    seconds: float | int,
    settings: MocapSettings,
    walk: WalkSettings,
    seed: int,
    jobs: int = -1,
    backend: str = "loky",
    scheduler: str | None = None,
    overwrite: bool = False,
) -> Report:
    """Make `recordings` of at most some seconds each of the training recordings of data sets that stand on level floors.

    Raises WearcapError as `MotionGraph` does, and for data sets without recordings to join.
    """
    roots = tuple(str(source) for source in sources)
    stores = [RecordingStore.open(root) for root in roots]
    inputs = [store.entries[name].sha256 for store in stores for name in store.names(SPLIT)]
    if not inputs:
        raise WearcapError("no training recordings", where=", ".join(roots), expected="motion capture to join")
    about = content_hash(inputs, asdict(walk), asdict(settings), float(seconds), seed, Path(motion_graph.__file__))
    tasks = []
    for number in range(recordings):
        name = f"walk_{number:04d}"
        make = partial(_walk, roots, walk, settings, name, float(seconds), 1_000_003 * seed + number)
        tasks.append(Task(name, make, SPLIT, about))
    return prepare(tasks, output, jobs=jobs, backend=backend, scheduler=scheduler, overwrite=overwrite)


@cache
def _graph(roots: tuple[str, ...], walk: WalkSettings) -> MotionGraph:
    """The graph of the training recordings that stand on level floors."""
    usable = []
    for store in map(RecordingStore.open, roots):
        for name in store.names(SPLIT):
            recording = store.load(name)
            if recording.floor is not None and recording.contacts is not None and not recording.object_motion:
                usable.append(recording)
    return MotionGraph(usable, walk)


def _walk(
    roots: tuple[str, ...], walk: WalkSettings, settings: MocapSettings, name: str, seconds: float, seed: int
) -> Recording:
    graph = _graph(roots, walk)
    motion, parts = graph.walk(seconds, seed)
    used = [graph.recordings[part.clip] for part in parts]
    licenses = "; ".join(dict.fromkeys(each.license for each in used))
    activities = ", ".join(dict.fromkeys(each.activity for each in used if each.activity))
    about = About(
        name, used[0].subject, "a walk through " + ", ".join(each.name for each in used), licenses, activities
    )
    return mocap_recording(motion, about, settings)
