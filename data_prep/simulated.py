"""The simulated wearer (HMD², MocapEvery), nothing to download; preset=quick (6 minutes of motion) or preset=standard (5 hours)."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import wearcap.sensors
import wearsim
from data_prep.shared.engine import Splits, Task
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.recording.recording import Recording
from wearcap.recording.store import SPLITS
from wearsim.recordings.simulate import SimulationConfig, simulate_recording

PRESETS = {
    "quick": {"recordings": {"train": 8, "val": 2, "test": 2}, "duration_s": 30},
    "standard": {"recordings": {"train": 120, "val": 10, "test": 20}, "duration_s": 120},
}


def source_files() -> str:
    """Digest of the simulator's source code."""
    folders = [Path(package.__file__ or "").parent for package in (wearsim, wearcap.sensors)]
    return content_hash(*(path for folder in folders for path in sorted(folder.rglob("*.py"))))


def split_tasks(
    prefix: str,
    recordings: Mapping[str, int],
    seed: int,
    splits: Splits,
    output: str,
    make: Callable[[str, str, int, Path], Recording],
    *settings: Any,
) -> list[Task]:
    """`recordings[split]` tasks of each split: `make` of (name, split, seed, output), hashed with settings and simulator.

    Raises WearcapError for an unknown split, or when a simulated person's name belongs to another split's list.
    """
    if unknown := set(recordings) - set(SPLITS):
        raise WearcapError(f"no split {min(unknown)!r}", expected=f"one of {', '.join(SPLITS)}")
    for split in recordings:
        if splits.of(f"sim-{split}-person-000") != split:
            what = f"people of the simulated {split} split are listed elsewhere"
            raise WearcapError(what, where=splits.path, expected=f"a line sim-{split}-*,{split}")
    simulator, tasks = source_files(), []
    for split, count in recordings.items():
        for index in range(count):
            name, number = f"{prefix}-{split}-{seed}-{index:04d}", seed * 1_000_000 + index
            key = content_hash(*settings, number, split, simulator)
            tasks.append(Task(name, partial(make, name, split, number, Path(output)), split, key))
    return tasks


def simulated_tasks(
    splits: Splits,
    recordings: dict[str, int],  # how many in each split
    duration_s: float | int,  # length of each
    fps: float | int = 60,
    points: bool = True,  # points that a head-worn SLAM system would observe
    activities: list[str] | None = None,  # a list of them, done in turn; null: drawn at random
    seed: int = 0,
    world: str | None = None,  # flat, outdoor, or null: drawn, three in ten outdoors
    # render the head camera's video (96x72 pixels, 30 Hz), with the wearer's own arms and legs: output/videos
    camera: bool = False,
    output: str = ".",
) -> list[Task]:
    """`recordings[split]` recordings of `duration_s` each; people and places of the splits never meet.

    With `camera`, the head camera's video is written to `output`/videos.

    The hash covers the simulator's own source, so that a better simulator makes its recordings again.
    `world` is "flat", "outdoor" or None (drawn). Raises WearcapError for an unknown split or world, or when a
    simulated person's name belongs to another split's list.
    """
    length, rate, chosen = float(duration_s), float(fps), tuple(activities) if activities else None
    config = SimulationConfig(duration_s=length, fps=rate, points=points, activities=chosen, world=world, camera=camera)
    if not config.duration_s > 0 or not config.fps > 0:
        raise WearcapError(f"recordings of {duration_s} s at {fps} Hz", expected="positive numbers")
    make = partial(simulate_recording, config)
    return split_tasks("sim", recordings, seed, splits, output, make, asdict(config))
