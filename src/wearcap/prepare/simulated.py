"""The simulated wearer's recordings: nothing to download, the same bytes for the same seed."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import wearcap.sensors
import wearcap.simulation
from wearcap.errors import WearcapError
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.recording.store import SPLITS
from wearcap.simulation.recordings.simulate import SimulationConfig, simulate_recording


@dataclass(frozen=True)
class Simulated:
    """One recording by seed; picklable, callable as a task."""

    config: SimulationConfig
    name: str
    split: str
    seed: int
    root: Path

    def __call__(self) -> Recording:
        return simulate_recording(self.config, self.name, self.split, self.seed, self.root)


def simulated_tasks(
    splits: Splits,
    recordings: dict[str, int],
    duration_s: float | int,
    fps: float | int,
    points: bool,
    activities: list[str] | None,
    seed: int,
    world: str | None = None,
    camera: bool = False,
    output: str = ".",
) -> list[Task]:
    """`recordings[split]` recordings of `duration_s` each; people and places of the splits never meet.

    With `camera`, the head camera's video is written to `output`/videos.

    The hash covers the simulator's own source, so that a better simulator makes its recordings again.
    `world` is "flat", "outdoor" or None (drawn). Raises WearcapError for an unknown split or world, or when a
    simulated person's name belongs to another split's list.
    """
    config = SimulationConfig(
        duration_s=float(duration_s),
        fps=float(fps),
        points=points,
        activities=tuple(activities) if activities else None,
        world=world,
        camera=camera,
    )
    if not config.duration_s > 0 or not config.fps > 0:
        raise WearcapError(f"recordings of {duration_s} s at {fps} Hz", expected="positive numbers")
    checked_splits(recordings, splits)
    simulator = source_files()
    tasks = []
    for split, count in recordings.items():
        for index in range(count):
            name = f"sim-{split}-{seed}-{index:04d}"
            make = Simulated(config, name, split, seed * 1_000_000 + index, Path(output))
            tasks.append(Task(name, make, split, content_hash(asdict(config), make.seed, split, simulator)))
    return tasks


def checked_splits(recordings: Mapping[str, int], splits: Splits) -> None:
    """Raises WearcapError for an unknown split, or when a simulated person's name belongs to another split's list."""
    if unknown := set(recordings) - set(SPLITS):
        raise WearcapError(f"no split {min(unknown)!r}", expected=f"one of {', '.join(SPLITS)}")
    for split in recordings:
        if splits.of(f"sim-{split}-person-000") != split:
            raise WearcapError(
                f"people of the simulated {split} split are listed elsewhere",
                where=splits.path,
                expected=f"a line sim-{split}-*,{split}",
            )


def source_files() -> str:
    """Digest of the simulator's source code."""
    folders = [Path(package.__file__ or "").parent for package in (wearcap.simulation, wearcap.sensors)]
    return content_hash(*(path for folder in folders for path in sorted(folder.glob("*.py"))))
