"""The simulated wearers' recordings: nothing to download, the same bytes for the same seed.

One source per system's data: `simulated` (HMD², MocapEvery), `simulated_hps`, `simulated_interactions` (iReplica) and
`simulated_objects` (ECHO). `cmu_surrounded` adds simulated surroundings to captured motion.
"""

import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

import wearcap.sensors
import wearsim
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.io.formats.environment import FILE_NAME, write_environment
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.prepare.engine import Splits, Task, content_hash
from wearcap.recording.recording import Recording
from wearcap.recording.store import SPLITS, RecordingFile, RecordingStore
from wearsim.places.site import changed_world
from wearsim.places.surround import surround
from wearsim.recordings.hps import HpsConfig, Protocol, simulate_hps
from wearsim.recordings.interaction_session import (
    InteractionConfig,
    ObjectConfig,
    simulate_interactions,
    simulate_objects,
)
from wearsim.recordings.localization_noise import LocalizationNoise
from wearsim.recordings.measured import EnvironmentErrors, as_measured
from wearsim.recordings.simulate import SimulationConfig, simulate_recording
from wearsim.rendering.ego_view import write_ego_video
from wearsim.rendering.head_camera import HEAD_CAMERA_TRUTH, Filming, write_head_video
from wearsim.rendering.scan import SceneSettings, scan_world, write_scene
from wearsim.rendering.views import Scenery
from wearsim.sensors.slam import semidense_points
from wearsim.sensors.suit import SuitNoise

MADE = "made.json"
"""File in a scene's folder that holds the settings with which it was made."""
TURNS, DOWN_DEG, VIEW_S = 12, (0.0, 38.0), 0.25
"""Steps per turn, pitch of each turn (°), duration of a step (s) of the wearer's turns on the spot before the recording."""


def source_files() -> str:
    """Digest of the simulator's source code."""
    folders = [Path(package.__file__ or "").parent for package in (wearsim, wearcap.sensors)]
    return content_hash(*(path for folder in folders for path in sorted(folder.rglob("*.py"))))


def _tasks(
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
    length, rate, chosen = float(duration_s), float(fps), tuple(activities) if activities else None
    config = SimulationConfig(duration_s=length, fps=rate, points=points, activities=chosen, world=world, camera=camera)
    if not config.duration_s > 0 or not config.fps > 0:
        raise WearcapError(f"recordings of {duration_s} s at {fps} Hz", expected="positive numbers")
    make = partial(simulate_recording, config)
    return _tasks("sim", recordings, seed, splits, output, make, asdict(config))


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
    claps = [simulated.to_camera(clap) for clap in simulated.session.claps_s]
    file = Path("videos") / f"{name}.mp4"
    write_head_video(root / file, Scenery.of(world), camera.camera, path, times, Filming(), rng, claps)
    return replace(recording, camera=replace(camera, timestamps=times, video=file.as_posix()))


def simulated_hps_tasks(
    splits: Splits,
    output: str,
    recordings: dict[str, int],
    fps: float | int,
    camera_fps: float | int,
    suit: str,
    localization: str,
    returns_m: list[float],
    end_m: float | int,
    spacing_m: float | None,
    photo_m: float | int,
    video_s: float | None,
    video_fps: float | int,
    changed: float | int,
    seed: int,
) -> list[Task]:
    """`recordings[split]` sessions each; people and sites of the splits never meet, and a split's sites are few.

    Scenes go to `output`/scenes: points `spacing_m` apart (None: no scene at all), photo stations `photo_m` apart
    (0: no photos). The first `video_s` (None: all) of each head camera are filmed at `video_fps`. `suit` and
    `localization` name presets of errors. Raises WearcapError as `simulated_tasks` does, for a preset that does not
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
        localization=LocalizationNoise.preset(localization),
    )
    scene = None if spacing_m is None else SceneSettings(spacing_m=float(spacing_m), photo_m=float(photo_m))
    seconds = None if video_s is None else float(video_s)
    video = {"seconds": seconds, "fps": float(video_fps), "changed": float(changed)}
    made = [asdict(part) if part else None for part in (config, scene)]
    return _tasks("hps", recordings, seed, splits, output, partial(_hps, config, scene, video), *made, video)


def _in_flat(
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
    recordings: dict[str, int],
    minutes: float | int,
    fps: float | int,
    camera_fps: float | int,
    suit: str,
    localization: str,
    measured: bool,
    spacing_m: float | int,
    seed: int,
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Scenes go to `output`/scenes, with points `spacing_m` apart; `measured` environments have the errors of measuring.
    `suit` and `localization` name presets of errors. Raises WearcapError as `simulated_tasks` does, and for a preset that does not exist.
    """
    if not spacing_m > 0:
        raise WearcapError(f"points {spacing_m} m apart", expected="a positive spacing")
    config = InteractionConfig(
        fps=float(fps),
        camera_fps=float(camera_fps),
        minutes=float(minutes),
        suit=SuitNoise.preset(suit),
        localization=LocalizationNoise.preset(localization),
    )
    make = partial(_in_flat, simulate_interactions, config, float(spacing_m), measured, source_files())
    return _tasks("interactions", recordings, seed, splits, output, make, asdict(config), float(spacing_m), measured)


def simulated_objects_tasks(
    splits: Splits, output: str, recordings: dict[str, int], minutes: float | int, fps: float | int, seed: int
) -> list[Task]:
    """`recordings[split]` recordings of some minutes each; people and flats of the splits never meet.

    Environments go to `output`/scenes. Raises WearcapError as `simulated_tasks` does.
    """
    config = ObjectConfig(fps=float(fps), minutes=float(minutes))
    make = partial(_in_flat, simulate_objects, config, None, False, source_files())
    return _tasks("objects", recordings, seed, splits, output, make, asdict(config))


def _surrounded(file: Path, name: str, root: Path, camera: bool, look_round: bool, seed: int) -> Recording:
    """One recording in its simulated surroundings, with semi-dense points along the head's path and, with `camera`, a video.

    With `look_round`, points that the wearer sees from the start of the path are available from its first frame.
    """
    recording = RecordingFile(file).load()
    motion, head = recording.motion, recording.head
    if motion is None or head is None:
        raise WearcapError("no motion or no head path", where=file, expected="motion capture with both")
    key = [seed, zlib.crc32(name.encode())]
    of_world, of_points, of_camera = (np.random.default_rng([number, *key]) for number in (31, 32, 33))
    world = surround(motion, of_world, f"cmu-room-{name}")
    path = head
    if look_round:  # the path is preceded by two turns on the spot, one level and one looking down
        ahead = head.R_world_device[0, :, 0]
        yaw = torch.atan2(ahead[1], ahead[0]) + torch.arange(TURNS) * (2 * torch.pi / TURNS)
        down = torch.tensor(DOWN_DEG).deg2rad().to(yaw.dtype)
        R = (rotation.about_axis("z", yaw)[None] @ rotation.about_axis("y", down)[:, None]).flatten(0, 1)
        before = head.timestamps[0] - VIEW_S * torch.arange(len(R), 0, -1, dtype=torch.float64)
        path = replace(
            head,
            timestamps=torch.cat([before, head.timestamps]),
            R_world_device=torch.cat([R.to(head.R_world_device.dtype), head.R_world_device]),
            t_world_device=torch.cat([head.t_world_device[:1].expand(len(R), 3), head.t_world_device]),
        )
    points = semidense_points(world.mesh, world.face_texture, path, of_points)
    assert points.first_seen is not None
    points = replace(points, first_seen=points.first_seen.clamp(min=head.timestamps[0].item()))
    recording = replace(recording, points=points, location=world.name)
    if not camera:
        return recording
    video = root / "videos" / f"{name}.mp4"
    stream = write_ego_video(video, world, motion, recording.shape, head.t_head_device, of_camera)
    return replace(recording, camera=stream)


def _evenly(names: list[str], count: int) -> list[str]:
    return [names[k * len(names) // count] for k in range(count)] if count < len(names) else names


def cmu_surrounded_tasks(
    source: str | Path,
    output: str | Path,
    splits: Splits,
    camera: bool,
    look_round: bool,
    seed: int,
    recordings: Mapping[str, int] | None,
) -> list[Task]:
    """One task per recording of the data set `source`, which `wearcap prepare cmu` made (floors at z = 0), or for
    `recordings[split]` of each split, evenly chosen.

    Videos of the head camera go to `output`/videos. The hash covers the recording and the simulator's own source.
    """
    store, simulator = RecordingStore.open(source), source_files()
    names = store.names()
    if recordings is not None:
        in_split = {split: [n for n in names if splits.of(store.entries[n].subject) == split] for split in recordings}
        names = [name for split, count in recordings.items() for name in _evenly(in_split[split], count)]
    tasks = []
    for name in names:
        entry = store.entries[name]
        make = partial(_surrounded, store.root / entry.file, name, Path(output), camera, look_round, seed)
        key = content_hash(entry.sha256, camera, look_round, seed, simulator)
        tasks.append(Task(name, make, splits.of(entry.subject), key))
    return tasks
