"""Simulated ECHO sessions: head device, body, everything that is used, moved and carried in a flat; preset=quick or preset=standard."""

from dataclasses import asdict
from functools import partial

from data_prep.shared.engine import Splits, Task
from data_prep.simulated import source_files, split_tasks
from data_prep.simulated_interactions import in_flat
from wearsim.recordings.interaction_session import ObjectConfig, simulate_objects

PRESETS = {
    "quick": {"recordings": {"train": 6, "val": 2, "test": 2}, "minutes": 1},
    "standard": {"recordings": {"train": 110, "val": 6, "test": 16}, "minutes": 2},
}


def simulated_objects_tasks(
    splits: Splits,
    output: str,
    recordings: dict[str, int],  # how many in each split
    minutes: float | int,  # of each recording
    fps: float | int = 30,
    seed: int = 0,
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Environments go to `output`/scenes. Raises WearcapError as `simulated_tasks` does.
    """
    config = ObjectConfig(fps=float(fps), minutes=float(minutes))
    make = partial(in_flat, simulate_objects, config, None, False, source_files())
    return split_tasks("objects", recordings, seed, splits, output, make, asdict(config))
