"""Simulated iReplica sessions: suit, head camera's localisation, scanned flats with objects that are moved; preset=quick or preset=standard."""

import json
import zlib
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.shared.engine import Splits, Task
from data_prep.simulated import source_files, split_tasks
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.recording.recording import Recording
from wearsim.recordings.interaction_session import InteractionConfig, ObjectConfig, simulate_interactions
from wearsim.recordings.localization_noise import LocalizationNoise
from wearsim.recordings.measured import EnvironmentErrors, as_measured
from wearsim.rendering.scan import scan_world
from wearsim.rendering.views import Scenery
from wearsim.sensors.suit import SuitNoise

PRESETS = {
    "quick": {"recordings": {"train": 6, "val": 2, "test": 2}, "minutes": 2, "spacing_m": 0.03},
    "standard": {"recordings": {"train": 48, "val": 6, "test": 10}, "minutes": 3, "spacing_m": 0.02},
}
MADE = "made.json"
"""File in a scene's folder that holds the settings with which it was made."""


def in_flat(
    simulate: Callable[..., Any],
    config: InteractionConfig | ObjectConfig,
    spacing_m: float | None,
    measured: bool,
    simulator: str,
    name: str,
    split: str,
    seed: int,
    root: Path,
) -> Recording:
    """One session in a flat; its environment and, with `spacing_m`, its scan with everything at its initial pose are written.

    With `measured`, the environment has the errors of somebody who measured where things are.
    Files that were made with the same settings by the same simulator are left as they are.
    """
    recording, flat = simulate(config, name, split, seed)
    place = Path("scenes") / recording.location
    folder, note = root / place, root / place / MADE
    made = {"measured": measured, "simulator": simulator} | ({} if spacing_m is None else {"spacing_m": spacing_m})
    wanted = json.dumps(made)
    files = [FILE_NAME] if spacing_m is None else [CLOUD, FILE_NAME]
    current = note.is_file() and note.read_text(encoding="utf-8") == wanted
    if not current or not all((folder / file).is_file() for file in files):
        if spacing_m is not None:
            scenery, rng = Scenery.of(flat.world), np.random.default_rng(12)
            scan = scan_world(scenery, spacing_m, rng, walked=flat.static)
            write_ply(Ply(scan.points, scan.colors), folder / CLOUD)
        rng = np.random.default_rng([13, zlib.crc32(recording.location.encode())])
        environment = as_measured(flat.environment, EnvironmentErrors(), rng) if measured else flat.environment
        write_environment(environment, folder / FILE_NAME)
        write_text(note, wanted)
    scene = {} if spacing_m is None else {"scene": (place / CLOUD).as_posix()}
    return replace(recording, environment=(place / FILE_NAME).as_posix(), **scene)


def simulated_interactions_tasks(
    splits: Splits,
    output: str,
    recordings: dict[str, int],  # how many in each split
    minutes: float | int,  # of each recording
    spacing_m: float | int,  # between points of the scans
    fps: float | int = 60,  # of the suit
    camera_fps: float | int = 30,
    suit: str = "typical",  # errors of the suit: ideal, typical or poor
    camera_errors: str = "typical",  # errors of the camera's localisation and its map: ideal, typical or poor
    measured: bool = True,  # objects 2 cm and 2° from where the environment says, hinges 1.5 cm; false: exactly there
    seed: int = 0,
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Scenes go to `output`/scenes, with points `spacing_m` apart; `measured` environments have the errors of measuring.
    `suit` and `camera_errors` name presets of errors. Raises WearcapError as `simulated_tasks` does, and for a preset that does not exist.
    """
    if not spacing_m > 0:
        raise WearcapError(f"points {spacing_m} m apart", expected="a positive spacing")
    config = InteractionConfig(
        fps=float(fps),
        camera_fps=float(camera_fps),
        minutes=float(minutes),
        suit=SuitNoise.preset(suit),
        localization=LocalizationNoise.preset(camera_errors),
    )
    make = partial(in_flat, simulate_interactions, config, float(spacing_m), measured, source_files())
    return split_tasks(
        "interactions", recordings, seed, splits, output, make, asdict(config), float(spacing_m), measured
    )
