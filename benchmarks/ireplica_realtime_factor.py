"""How much faster than real time a recording's wearer and objects are captured, from localised cameras on."""

import time
from pathlib import Path

import torch
from ireplica_runs import Case, pipeline_of

from wearcap.errors import WearcapError
from wearcap.recording import RecordingStore

DATASET = Path("datasets/simulated_interactions")
CHECKPOINT = Path("checkpoints/contact_sequence.ckpt")
GOAL = 10.0


def run() -> dict[str, object]:
    """One test recording: HPS' registration, contacts, tracking; and the last two alone beside it."""
    if not (DATASET / "manifest.json").is_file():
        raise WearcapError("no such data set", where=DATASET,
                           fix="Run: wearcap prepare simulated_interactions preset=quick")  # fmt: skip
    case = Case.load(DATASET, RecordingStore.open(DATASET).names("test")[0])
    pipeline = pipeline_of("ireplica", (CHECKPOINT,))
    pipeline.hps.solver.keywords["jobs"] = torch.get_num_threads()  # pyright: ignore[reportFunctionMemberAccess]
    suit = case.recording.suit
    assert suit is not None
    case.source.read_scan()
    for _ in range(2):  # the first pass compiles
        begin = time.perf_counter()
        motion = pipeline.registered(case.source)
        registered = time.perf_counter() - begin
        begin = time.perf_counter()
        pipeline.interact(motion, pipeline.contacts(suit), case.environment)
        tracked = time.perf_counter() - begin
    length = case.recording.duration_s
    return {
        "name": "ireplica_realtime_factor", "value": round(length / (registered + tracked), 1), "unit": "x real time",
        "baseline": round(length / tracked, 1), "ratio": round(length / (registered + tracked), 1), "goal": GOAL,
        "about": f"{length:.0f} s, {len(case.environment)} objects; baseline: contacts and objects alone, HPS' motion given",
    }  # fmt: skip
