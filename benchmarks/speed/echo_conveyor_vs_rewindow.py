"""ECHO's conveyor against windows that are denoised from scratch (h = 10): time per frame, errors and jitter of both.

All have the context of `pipeline=ablation/echo_conveyor`, no guidance, in the same batch, in turn. Windows with all of a frame's steps on
the conveyor (112) need those for 10 frames, the conveyor two for each: 5.6 times as many evaluations of the network,
less its queue. "Equal" windows take the 20 evaluations that the conveyor takes for 10 frames. Of times (ms per frame and
batch item, once the conveyor's window is full) value is the conveyor's, baseline the windows', ratio = baseline / value, to be
at least `goal`. Where there is the test split of datasets/simulated_objects, also MPJPE (mm),
E_v2v (cm) and jitter (m/s³) over the beginnings of some of its recordings: value the conveyor's, baseline the
windows', ratio = value / baseline, to be at most `goal`.
"""

import statistics
import sys
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.speed.echo_runs import conditions_of, pipeline_of
from benchmarks.speed.figures import figure, seconds
from wearcap.recording import RecordingStore
from wearcap.recording.timing import first_seconds
from wearcap.runtime.system import CaptureInput
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.queue import Conditioning, EchoQueue
from wearcap.systems.echo.windows import Rewindow

STRIDE = 10
EQUAL = "equal"
DATASET = Path(__file__).resolve().parents[2] / "datasets" / "simulated_objects"
SCORES = {"mpjpe_mm": "mm MPJPE", "v2v_cm": "cm E_v2v", "jitter_m_s3": "m/s³ of the joints"}


def measure(items: int = 4, rounds: int = 6, recordings: int = 4, length_s: float = 20.0) -> list[dict]:
    conveyor = pipeline_of("ablation/echo_conveyor", guided=False)
    windows = replace(conveyor, sampling=replace(conveyor.sampling, rewindow=STRIDE, average=False))
    few = replace(windows.sampling, rewindow_steps=STRIDE * conveyor.sampling.per_frame)
    pipelines = {"conveyor": conveyor, "rewindow": windows, EQUAL: replace(windows, sampling=few)}
    rows = _time(pipelines, items, rounds)
    if recordings and (DATASET / "manifest.json").is_file():
        rows += _errors(pipelines, recordings, length_s)
    else:
        print(f"no {DATASET}: time alone", file=sys.stderr)
    return rows


@torch.no_grad()
def _time(pipelines: dict[str, Echo], items: int, rounds: int) -> list[dict]:
    """In turn: as many frames through the queue as one window gives."""
    conveyor, *others = pipelines.values()
    window = conveyor.model.net.window
    conditioning = conditions_of(conveyor, items, (window + STRIDE * (rounds + 1)) / conveyor.fps)
    queue, windows = _queue(conveyor, items), [_queue(pipeline, items) for pipeline in others]
    for number in range(window):
        queue.push(conditioning.frames(slice(number, number + 1)))
    first = conditioning.frames(slice(0, window))
    before = torch.zeros(items, 0, sum(conveyor.model.net.sizes))
    befores = [_rewindow(each).window(first, before)[:, : conveyor.sampling.context] for each in windows]
    times: list[list[float]] = [[] for _ in pipelines]
    for number in range(rounds):
        there = conditioning.frames(slice(STRIDE * number, STRIDE * number + window))
        runs = [lambda start=window + STRIDE * number: _pushed(queue, conditioning, start)]
        runs += [
            lambda again=again, before=before, there=there: _rewindow(again).window(there, before)
            for again, before in zip(windows, befores)
        ]
        for taken, run in zip(times, runs):
            taken.append(seconds(run))
    value, full, equal = (1000 * statistics.median(taken) / STRIDE / items for taken in times)
    unit = "ms per frame and batch item, no guidance"
    return [
        figure("echo_conveyor_vs_rewindow", value, unit, full, full / value, 5.0),
        figure("echo_conveyor_vs_equal_windows", value, f"{unit}; as many evaluations", equal, equal / value, 1.0),
    ]


def _rewindow(queue: EchoQueue) -> Rewindow:
    assert isinstance(queue, Rewindow)
    return queue


def _queue(pipeline: Echo, items: int) -> EchoQueue:
    pipeline.prepare()
    return pipeline.queue([pipeline.model.skeleton] * items, list(range(items)), [{}] * items, [[]] * items)


def _pushed(queue: EchoQueue, conditioning: Conditioning, start: int) -> None:
    for number in range(start, start + STRIDE):
        queue.push(conditioning.frames(slice(number, number + 1)))


def _errors(pipelines: dict[str, Echo], recordings: int, length_s: float) -> list[dict]:
    """Means over recordings; of the object over those in which one is active."""
    store = RecordingStore.open(DATASET)
    shown = [first_seconds(store.load(name), length_s) for name in store.names("test")[:recordings]]
    means = {}
    for pipeline_name, pipeline in pipelines.items():
        sources = [CaptureInput(recording, store.root) for recording in shown]
        motions = pipeline.motions(sources, [0] * len(shown))
        scores = [pipeline.score(motion, source, 0).scores for motion, source in zip(motions, sources)]
        means[pipeline_name] = {
            name: statistics.mean(score[name] for score in scores if name in score) for name in SCORES
        }
    of = f", {length_s:g} s of {len(shown)} recordings, one seed"
    figures = []
    for windows in ("rewindow", EQUAL):
        what = of if windows != EQUAL else f"{of}; as many evaluations"
        mark = "" if windows != EQUAL else "_equal"
        for name, unit in SCORES.items():
            ours, theirs = means["conveyor"][name], means[windows][name]
            figures.append(figure(f"echo_conveyor{mark}_{name}", ours, unit + what, theirs, ours / theirs, 1.0))
    return figures
