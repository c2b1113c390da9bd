"""Simulated ECHO recordings, each with the environment whose objects are used, moved and carried."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from wearcap.files import write_text
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.simulated import checked_splits, source_files
from wearcap.prepare.simulated_interactions import MADE, is_made
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.simulation.recordings.interaction_session import ObjectConfig, simulate_objects


@dataclass(frozen=True)
class SimulatedObjectsTask:
    """One recording by seed, and its environment if missing; picklable, callable as a task."""

    config: ObjectConfig
    simulator: str
    name: str
    split: str
    seed: int
    root: Path

    def __call__(self) -> Recording:
        recording, flat = simulate_objects(self.config, self.name, self.split, self.seed)
        file = Path("scenes") / recording.location / FILE_NAME
        wanted = json.dumps({"simulator": self.simulator})
        if not is_made(self.root / file.parent, wanted, FILE_NAME):
            write_environment(flat.environment, self.root / file)
            write_text(self.root / file.parent / MADE, wanted)
        return replace(recording, environment=file.as_posix())


def simulated_objects_tasks(
    splits: Splits, output: str, recordings: dict[str, int], minutes: float | int, fps: float | int, seed: int
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Environments go to `output`/scenes. Raises WearcapError for an unknown split, or when a simulated person's name
    belongs to another split's list.
    """
    checked_splits(recordings, splits)
    config = ObjectConfig(fps=float(fps), minutes=float(minutes))
    simulator, tasks = source_files(), []
    for split, count in recordings.items():
        for index in range(count):
            name, number = f"objects-{split}-{seed}-{index:04d}", seed * 1_000_000 + index
            make = SimulatedObjectsTask(config, simulator, name, split, number, Path(output))
            tasks.append(Task(name, make, split, content_hash(asdict(config), number, split, simulator)))
    return tasks
