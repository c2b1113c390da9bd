"""ECHO's conveyor against windows that are denoised from scratch (h = 10): time per frame, and error of both.

Both have the context and the steps of `pipeline=echo`, no guidance, in the same batch, in turn. Windows need all steps
(112) for 10 frames, the conveyor two for each: 5.6 times as many, less its queue. value: the conveyor's ms per frame
and batch item, once its window is full; baseline: the windows'; ratio = baseline / value, to be at least `goal`. Where there is
a checkpoint `echo` and the test split of datasets/simulated_objects, also E_v2v (cm) and MPJPE (mm) over the beginnings
of some of its recordings: value the conveyor's, baseline the windows', ratio = value / baseline, to be at most `goal`.
"""

import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from echo_runs import NAME, conditions_of, figure, pipeline_of

from wearcap.models.checkpoint import shared_checkpoints
from wearcap.recording import Recording, RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.queue import Conditioning, EchoQueue, Rewindow

STRIDE = 10
DATASET = Path(__file__).resolve().parents[1] / "datasets" / "simulated_objects"


def measure(items: int = 4, rounds: int = 6, recordings: int = 4, seconds: float = 20.0) -> list[dict]:
    conveyor = pipeline_of("echo", guided=False)
    windows = replace(conveyor, sampling=replace(conveyor.sampling, rewindow=STRIDE))
    rows = [_time(conveyor, windows, items, rounds)]
    if NAME in shared_checkpoints() and (DATASET / "manifest.json").is_file():
        rows += _errors(conveyor, windows, recordings, seconds)
    else:
        print(f"no checkpoint {NAME!r} or no {DATASET}: time alone", file=sys.stderr)
    return rows


@torch.no_grad()
def _time(conveyor: Echo, windows: Echo, items: int, rounds: int) -> dict:
    """In turn: as many frames through the queue as one window gives."""
    window = conveyor.model.net.window
    conditioning = conditions_of(conveyor, items, (window + STRIDE * (rounds + 1)) / conveyor.fps)
    queue, again = _queue(conveyor, items), _queue(windows, items)
    assert isinstance(again, Rewindow)
    for number in range(window):
        queue.push(conditioning.frames(slice(number, number + 1)))
    first = conditioning.frames(slice(0, window))
    before = again.window(first, torch.zeros(items, 0, sum(conveyor.model.net.sizes)))[:, : conveyor.sampling.context]
    ours, theirs = [], []
    for number in range(rounds):
        ours.append(_seconds(lambda start=window + STRIDE * number: _pushed(queue, conditioning, start)))
        there = conditioning.frames(slice(STRIDE * number, STRIDE * number + window))
        theirs.append(_seconds(lambda there=there: again.window(there, before)))
    value, baseline = (1000 * statistics.median(times) / STRIDE / items for times in (ours, theirs))
    return figure("echo_conveyor_vs_rewindow", value, "ms/frame", baseline, baseline / value, 5.0)


def _queue(pipeline: Echo, items: int) -> EchoQueue:
    pipeline.prepare()
    return pipeline.queue([pipeline.model.skeleton] * items, list(range(items)), [{}] * items, [[]] * items)


def _pushed(queue: EchoQueue, conditioning: Conditioning, start: int) -> None:
    for number in range(start, start + STRIDE):
        queue.push(conditioning.frames(slice(number, number + 1)))


def _seconds(run) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def _errors(conveyor: Echo, windows: Echo, recordings: int, seconds: float) -> list[dict]:
    """Means over recordings; of the object over those in which one is active."""
    store = RecordingStore.open(DATASET)
    shown = [_beginning(store.load(name), seconds) for name in store.names("test")[:recordings]]
    means = []
    for pipeline in (conveyor, windows):
        sources = [CaptureInput(recording, store.root) for recording in shown]
        motions = pipeline.motions(sources, [0] * len(shown))
        scores = [pipeline.score(motion, source, 0).scores for motion, source in zip(motions, sources)]
        means.append(
            {name: statistics.mean(score[name] for score in scores if name in score) for name in ("v2v_cm", "mpjpe_mm")}
        )
    ours, theirs = means
    return [
        figure(f"echo_conveyor_{name}", ours[name], unit, theirs[name], ours[name] / theirs[name], 1.0)
        for name, unit in (("v2v_cm", "cm"), ("mpjpe_mm", "mm"))
    ]


def _beginning(recording: Recording, seconds: float) -> Recording:
    """Its first seconds: the head's path determines how long the capture is."""
    head = recording.head
    assert head is not None
    count = int(torch.searchsorted(head.timestamps, head.timestamps[0] + seconds))
    return replace(
        recording,
        head=replace(
            head,
            timestamps=head.timestamps[:count],
            R_world_device=head.R_world_device[:count],
            t_world_device=head.t_world_device[:count],
        ),
    )
