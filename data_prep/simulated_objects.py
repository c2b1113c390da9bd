"""Simulated ECHO sessions: everything that is used, moved and carried in a flat."""

from dataclasses import asdict
from functools import partial

from data_prep.shared.engine import Splits, Task
from data_prep.simulated import source_files, split_tasks
from data_prep.simulated_interactions import in_flat
from wearsim.recordings.interaction_session import ObjectConfig, simulate_objects


def simulated_objects_tasks(
    splits: Splits, output: str, recordings: dict[str, int], minutes: float | int, fps: float | int, seed: int
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Environments go to `output`/scenes. Raises WearcapError as `simulated_tasks` does.
    """
    config = ObjectConfig(fps=float(fps), minutes=float(minutes))
    make = partial(in_flat, simulate_objects, config, None, False, source_files())
    return split_tasks("objects", recordings, seed, splits, output, make, asdict(config))
