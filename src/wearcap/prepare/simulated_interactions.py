"""Simulated iReplica recordings, each with its interactive environment: a scan, and the objects that can be moved."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.simulated import checked_splits, source_files
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.simulation.places.interactive_flat import InteractiveFlat
from wearcap.simulation.recordings.interaction_session import InteractionConfig, simulate_interactions
from wearcap.simulation.rendering.scan import scan_world
from wearcap.simulation.rendering.views import Scenery

MADE = "made.json"


@dataclass(frozen=True)
class SimulatedInteractionsTask:
    """One recording by seed, and the missing files of its scene; picklable, callable as a task."""

    config: InteractionConfig
    spacing_m: float
    simulator: str
    name: str
    split: str
    seed: int
    root: Path

    def __call__(self) -> Recording:
        recording, flat = simulate_interactions(self.config, self.name, self.split, self.seed)
        folder = Path("scenes") / recording.location
        self._write_scene(flat, self.root / folder)
        return replace(recording, scene=(folder / CLOUD).as_posix(), environment=(folder / FILE_NAME).as_posix())

    def _write_scene(self, flat: InteractiveFlat, folder: Path) -> None:
        """Write the scan with everything at its initial pose and the objects, unless they exist already."""
        wanted = json.dumps({"spacing_m": self.spacing_m, "simulator": self.simulator})
        if is_made(folder, wanted, CLOUD, FILE_NAME):
            return
        rng = np.random.default_rng(12)
        scan = scan_world(Scenery.of(flat.world), self.spacing_m, rng, walked=flat.static)
        write_ply(Ply(scan.points, scan.colors), folder / CLOUD)
        write_environment(flat.environment, folder / FILE_NAME)
        write_text(folder / MADE, wanted)


def is_made(folder: Path, wanted: str, *files: str) -> bool:
    """Whether a scene's files exist and were made with the settings `wanted`."""
    note = folder / MADE
    current = note.is_file() and note.read_text(encoding="utf-8") == wanted
    return current and all((folder / file).is_file() for file in files)


def simulated_interactions_tasks(
    splits: Splits,
    output: str,
    recordings: dict[str, int],
    minutes: float | int,
    fps: float | int,
    camera_fps: float | int,
    spacing_m: float | int,
    seed: int,
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Scenes go to `output`/scenes, with points `spacing_m` apart. Raises WearcapError for an unknown split, or when a
    simulated person's name belongs to another split's list.
    """
    checked_splits(recordings, splits)
    if not spacing_m > 0:
        raise WearcapError(f"points {spacing_m} m apart", expected="a positive spacing")
    config = InteractionConfig(fps=float(fps), camera_fps=float(camera_fps), minutes=float(minutes))
    simulator, tasks = source_files(), []
    for split, count in recordings.items():
        for index in range(count):
            name, number = f"interactions-{split}-{seed}-{index:04d}", seed * 1_000_000 + index
            make = SimulatedInteractionsTask(config, float(spacing_m), simulator, name, split, number, Path(output))
            key = content_hash(asdict(config), float(spacing_m), number, split, simulator)
            tasks.append(Task(name, make, split, key))
    return tasks
