"""iReplica on a simulated recording, localised cameras given: seconds captured per second, on all cores.

Everything from the suit's pose and the localisation to the motion of wearer and objects: HPS' alignment, start and
optimisation, contacts, tracking. value: seconds of recording per second of work; baseline: real time, 1; ratio =
value / baseline, to be at least `goal`. The second figure is contacts and tracking alone, HPS' motion given.
"""

import time
from pathlib import Path

import torch

from benchmarks.speed.figures import figure
from benchmarks.tables.ireplica_runs import Case, pipeline_of
from wearcap.errors import WearcapError
from wearcap.recording import RecordingStore

DATASET = Path("datasets/simulated_interactions")
CHECKPOINT = "contact_sequence"
GOAL = 10.0


def measure() -> list[dict]:
    if not (DATASET / "manifest.json").is_file():
        raise WearcapError(
            "no such data set", where=DATASET, fix="Run: wearcap prepare simulated_interactions preset=quick"
        )
    case = Case.load(DATASET, RecordingStore.open(DATASET).names("test")[0])
    pipeline = pipeline_of("ireplica", (CHECKPOINT,), jobs=torch.get_num_threads())
    registered = tracked = 0.0
    for _ in range(2):  # the first round compiles
        begin = time.perf_counter()
        motion = pipeline.registered(case.source)
        middle = time.perf_counter()
        pipeline.interact(motion, pipeline.contacts(case.recording), case.environment)
        registered, tracked = middle - begin, time.perf_counter() - middle
    length = case.recording.duration_s
    return [
        figure(name, length / seconds, "s/s", 1.0, length / seconds, GOAL)
        for name, seconds in (
            ("ireplica_realtime_factor", registered + tracked),
            ("ireplica_realtime_factor_without_hps", tracked),
        )
    ]
