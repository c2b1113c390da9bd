"""Simulated HPS sessions: suit, wrist sensors, head camera, localisation, scanned sites; preset=quick (one walk, scan of 2 cm, about 500 photos, half a minute of video) or preset=standard."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.shared.engine import Splits, Task
from data_prep.simulated import split_tasks
from wearcap.errors import WearcapError
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.recording.recording import Recording
from wearsim.places.site import changed_world
from wearsim.recordings.hps import HpsConfig, Protocol, simulate_hps
from wearsim.recordings.localization_noise import LocalizationNoise
from wearsim.rendering.head_camera import HEAD_CAMERA_TRUTH, Filming, write_head_video
from wearsim.rendering.scan import SceneSettings, write_scene
from wearsim.rendering.views import Scenery
from wearsim.sensors.suit import SuitNoise

PRESETS = {
    "quick": {"recordings": {"test": 1}, "spacing_m": 0.02, "photo_m": 2.6, "video_s": 30},
    "standard": {"recordings": {"train": 2, "val": 3, "test": 5}, "spacing_m": 0.015, "photo_m": 1.8, "video_s": 60},
}


def _hps(
    config: HpsConfig, scene: SceneSettings | None, video: dict[str, Any], name: str, split: str, seed: int, root: Path
) -> Recording:
    """One session, the missing files of its scene, and its video; the camera's timestamps become those of the frames.

    `video`: the `seconds` that are filmed from the start on (0: none, None: all), at `fps`, with a share `changed` of the
    movable objects moved or removed since the scan.
    """
    simulated = simulate_hps(config, name, split, seed)
    recording = simulated.recording
    if scene is not None:
        folder = Path("scenes") / recording.location
        write_scene(Scenery.of(simulated.world), root / folder, scene, 0, turn=seed)
        recording = replace(recording, scene=(folder / CLOUD).as_posix())
    if video["seconds"] == 0:
        return recording
    rng = np.random.default_rng([21, seed])
    share = video["changed"]
    world = changed_world(simulated.world, rng, 0.7 * share, 0.3 * share) if share else simulated.world
    camera, path = recording.camera, recording.object_motion[HEAD_CAMERA_TRUTH]
    assert camera is not None
    times = camera.timestamps[:: max(1, round(config.camera_fps / video["fps"]))]
    stop = np.inf if video["seconds"] is None else camera.timestamps[0].item() + video["seconds"]
    times = times[times < stop]
    claps = [simulated.to_camera(clap) for clap in simulated.claps_s]
    file = Path("videos") / f"{name}.mp4"
    write_head_video(root / file, Scenery.of(world), camera.camera, path, times, Filming(), rng, claps)
    return replace(recording, camera=replace(camera, timestamps=times, video=file.as_posix()))


def simulated_hps_tasks(
    splits: Splits,
    output: str,
    recordings: dict[str, int],  # how many in each split
    spacing_m: float | None,  # between points of the scan; null: no scenes
    photo_m: float | int,  # between the photo rig's stations; 0: no photos
    video_s: float | int | None,  # filmed duration (s) of each head camera; 0: none, null: all
    fps: float | int = 60,  # suit and wrist sensors
    camera_fps: float | int = 30,
    suit: str = "typical",  # errors of the suit: ideal, typical or poor
    camera_errors: str = "typical",  # errors of the camera's localisation and its map: ideal, typical or poor
    # distances travelled after which the wearer is back at the capture spot
    returns_m: Sequence[float | int] = (70, 200, 380),
    end_m: float | int = 410,
    video_fps: float | int = 5,
    changed: float | int = 0.3,  # share of the movable objects that were moved or removed since the scan
    seed: int = 0,
) -> list[Task]:
    """`recordings[split]` sessions each; people and sites of the splits never meet, and a split's sites are few.

    Scenes go to `output`/scenes: points `spacing_m` apart (None: no scene at all), photo stations `photo_m` apart
    (0: no photos). The first `video_s` (None: all) of each head camera are filmed at `video_fps`. `suit` and
    `camera_errors` name presets of errors. Raises WearcapError as `simulated_tasks` does, for a preset that does not
    exist, and for distances that do not rise.
    """
    distances = [0.0, *map(float, returns_m), float(end_m)]
    if any(b <= a for a, b in pairwise(distances)):
        raise WearcapError(f"returns at {returns_m} m, end at {end_m} m", expected="distances that rise")
    protocol = Protocol(returns_m=tuple(distances[1:-1]), end_m=distances[-1])
    config = HpsConfig(
        fps=float(fps),
        camera_fps=float(camera_fps),
        protocol=protocol,
        suit=SuitNoise.preset(suit),
        localization=LocalizationNoise.preset(camera_errors),
    )
    scene = None if spacing_m is None else SceneSettings(spacing_m=float(spacing_m), photo_m=float(photo_m))
    seconds = None if video_s is None else float(video_s)
    video = {"seconds": seconds, "fps": float(video_fps), "changed": float(changed)}
    made = [asdict(part) if part else None for part in (config, scene)]
    return split_tasks("hps", recordings, seed, splits, output, partial(_hps, config, scene, video), *made, video)
