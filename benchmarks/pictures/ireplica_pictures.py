"""Contact sheets of captured interactions, truth above and capture below, for the pages: chosen by what was moved.

python -m benchmarks.pictures.ireplica_pictures DATASET SPLIT CHECKPOINT OUTPUT
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.tables.ireplica_runs import Case, pipeline_of
from wearcap.apps.viewer.picture import contact_sheet, save_png
from wearcap.apps.viewer.shown import with_objects
from wearcap.body.anny_body import anny_body
from wearcap.metrics.objects import handlings
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.timing import at_times
from wearcap.scene.objects import Environment

FRAMES, AROUND_S = 5, 0.5
NEAR_M = 2.2
"""Other objects are drawn when they are so near to the one that is moved."""
WANTED = {"door": ("door",), "sofa": ("sofa",), "table": ("table",), "chair": ("chair",), "drawer": ("drawer",)}


def draw(dataset: Path, split: str, checkpoint: str, folder: Path) -> None:
    """One sheet per kind of object, of its longest handling; sofas by two hands."""
    pipeline, best = pipeline_of("ireplica", (checkpoint,)), {}
    for name in RecordingStore.open(dataset).names(split):
        case = Case.load(dataset, name)
        held = case.recording.interactions
        assert held is not None
        for object_name, start, stop in handlings(held.start_s, held.stop_s, held.objects):
            kind = case.environment.by_name(object_name).category
            inside = (held.start_s >= start) & (held.start_s < stop)
            both = bool((held.hands[inside].sum(1) == 2).any())
            worth = (both or kind not in ("sofa", "table"), min(stop - start, 9.0))
            if kind in WANTED and worth > best.get(kind, ((False, 0.0),))[0]:
                best[kind] = (worth, name, object_name, start, stop)
    for kind, (_, name, object_name, start, stop) in best.items():
        case = Case.load(dataset, name)
        placed = pipeline.placed(case.environment, case.source)
        motion = pipeline.interact(pipeline.registered(case.source), pipeline.contacts(case.recording), placed)
        truth = with_objects(case.recording)
        assert truth is not None
        true = replace(at_times(truth, motion.timestamps), object_motion=truth.object_motion)
        save_png(folder / f"{kind}.png", sheet(case, true, motion, object_name, start, stop))


def sheet(case: Case, true: Motion, motion: Motion, object_name: str, start: float, stop: float) -> np.ndarray:
    """Truth and capture from before the touch to behind the release."""
    times = torch.linspace(start - AROUND_S, stop + AROUND_S, FRAMES, dtype=torch.float64)
    frames = torch.searchsorted(motion.timestamps, times).clamp(0, len(motion) - 1).tolist()
    body = anny_body(motion.skeleton, case.recording.shape or None)
    return contact_sheet(
        {"truth": true, "captured": motion},
        frames,
        columns=FRAMES,
        size=(300, 300),
        body=body,
        environment=surroundings(case.environment, object_name),
        distance=5.0,
    )


def surroundings(environment: Environment, object_name: str) -> Environment:
    """What is moved, and what stands beside it, walls of cupboards and doors that would hide it left out."""
    moved = environment.by_name(object_name)
    near = [
        item
        for item in environment.objects
        if item is moved
        or (
            float((item.t_world_object - moved.t_world_object).norm()) < NEAR_M
            and item.category in ("sofa", "armchair", "table", "coffee_table", "chair", "box")
        )
    ]
    return Environment(tuple(near))


if __name__ == "__main__":
    draw(Path(sys.argv[1]), sys.argv[2], sys.argv[3], Path(sys.argv[4]))
