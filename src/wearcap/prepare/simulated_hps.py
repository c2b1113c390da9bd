"""Simulated HPS recordings with their scenes: scan, database photos and, optionally, the head camera's video."""

from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.io.formats.scene_folder import CLOUD
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.simulated import checked_splits, source_files
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.simulation.places.site import changed_world
from wearcap.simulation.recordings.hps import HpsConfig, Protocol, Simulated, simulate_hps
from wearcap.simulation.recordings.scene_files import SceneSettings, write_scene
from wearcap.simulation.rendering.head_camera import HEAD_CAMERA_TRUTH, Filming, write_head_video
from wearcap.simulation.rendering.views import Scenery


@dataclass(frozen=True)
class Video:
    """Settings of the head camera's rendered video."""

    seconds: float | None
    """Rendered duration (s) from the recording's start; 0: nothing, None: all of it."""
    fps: float
    changed: float
    """Share of the movable objects that have been moved or removed since the scan when the video is filmed."""


@dataclass(frozen=True)
class SimulatedHps:
    """One recording by seed, and the missing files of its scene; picklable, callable as a task."""

    config: HpsConfig
    scene: SceneSettings | None
    video: Video
    name: str
    split: str
    seed: int
    root: Path

    def __call__(self) -> Recording:
        simulated = simulate_hps(self.config, self.name, self.split, self.seed)
        recording = simulated.recording
        if self.scene is not None:
            folder = Path("scenes") / recording.location
            write_scene(Scenery.of(simulated.world), self.root / folder, self.scene, 0, turn=self.seed)
            recording = replace(recording, scene=(folder / CLOUD).as_posix())
        return recording if self.video.seconds == 0 else self._filmed(simulated, recording)

    def _filmed(self, simulated: Simulated, recording: Recording) -> Recording:
        """Render the first seconds; the camera's timestamps become those of the frames."""
        rng = np.random.default_rng([21, self.seed])
        share = self.video.changed
        world = changed_world(simulated.world, rng, 0.7 * share, 0.3 * share) if share else simulated.world
        camera, path = recording.camera, recording.object_motion[HEAD_CAMERA_TRUTH]
        assert camera is not None
        every = max(1, round(self.config.camera_fps / self.video.fps))
        stop = np.inf if self.video.seconds is None else camera.timestamps[0].item() + self.video.seconds
        times = camera.timestamps[::every]
        times = times[times < stop]
        claps = [simulated.to_camera(clap) for clap in simulated.session.claps_s]
        file = Path("videos") / f"{self.name}.mp4"
        write_head_video(self.root / file, Scenery.of(world), camera.camera, path, times, Filming(), rng, claps)
        return replace(recording, camera=replace(camera, timestamps=times, video=file.as_posix()))


def simulated_hps_tasks(
    splits: Splits,
    output: str,
    recordings: dict[str, int],
    fps: float | int,
    camera_fps: float | int,
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
    (0: no photos). The first `video_s` (None: all) of each head camera are filmed at `video_fps`. Raises
    WearcapError for an unknown split, distances that do not rise, or when a simulated person's name belongs to
    another split's list.
    """
    distances = [0.0, *map(float, returns_m), float(end_m)]
    if any(b <= a for a, b in pairwise(distances)):
        raise WearcapError(f"returns at {returns_m} m, end at {end_m} m", expected="distances that rise")
    checked_splits(recordings, splits)
    protocol = Protocol(returns_m=tuple(distances[1:-1]), end_m=distances[-1])
    config = HpsConfig(fps=float(fps), camera_fps=float(camera_fps), protocol=protocol)
    scene = None if spacing_m is None else SceneSettings(spacing_m=float(spacing_m), photo_m=float(photo_m))
    video = Video(None if video_s is None else float(video_s), float(video_fps), float(changed))
    simulator, made = source_files(), [asdict(part) if part else None for part in (config, scene, video)]
    tasks = []
    for split, count in recordings.items():
        for index in range(count):
            name, number = f"hps-{split}-{seed}-{index:04d}", seed * 1_000_000 + index
            make = SimulatedHps(config, scene, video, name, split, number, Path(output))
            tasks.append(Task(name, make, split, content_hash(*made, number, split, simulator)))
    return tasks
