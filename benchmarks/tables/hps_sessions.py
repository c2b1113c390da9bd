"""Simulated HPS sessions with their scan and what depth cameras at the capture spot saw, kept on disk.

A session is made again when its settings or the simulator's source change; older ones of the same seed are removed.
"""

import json
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from benchmarks.rivals.hps_scores import RigCloud, nearest_frames, visit_times
from benchmarks.tables.depth_rig import Background, DepthView, person_cloud, voxel_downsample
from benchmarks.tables.simulated_depth_rig import approximate, place_rig, simulate_rig
from data_prep.simulated import source_files
from wearcap.body.anny_body import anny_body
from wearcap.files import content_hash, write_text
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.ply import Ply, read_ply, write_ply
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.scene.scan import Scan
from wearcap.sensors.claps import detect_claps_audio
from wearcap.sensors.clock import Clock
from wearsim.places.world import World
from wearsim.recordings.hps import HpsConfig, simulate_hps
from wearsim.rendering.head_camera import SOUND_HZ, sound_track
from wearsim.rendering.scan import scan_world
from wearsim.rendering.views import Scenery

RIG_SCENE_M = 8.0
"""Of the scan around the spot, the rig is registered to."""
CLOUD_VOXEL_M = 0.01
"""The rig's clouds are thinned to: still twice as dense as the body's vertices."""
RECORDING, SCAN, CLOUDS, ABOUT = "recording.safetensors", "scan.ply", "clouds.ply", "session.json"


@dataclass(frozen=True)
class SessionSettings:
    """What is simulated, scanned and seen by the rig."""

    split: str = "test"
    config: HpsConfig = field(default_factory=HpsConfig)
    spacing_m: float = 0.02
    """Between points of the scan."""
    instants: int = 10
    """Of every visit at the capture spot."""


@dataclass(frozen=True, eq=False)
class Session:
    """A recording whose clocks are still apart, its scan, the rig's clouds per visit, and the rig's own errors."""

    recording: Recording
    scan: Scan
    visits: tuple[tuple[RigCloud, ...], ...]
    rig_error_m: tuple[float, ...]
    """Of each depth camera's registered position."""


def load_session(settings: SessionSettings, seed: int, cache: Path) -> Session:
    """The session of a seed, simulated where the cache has none of these settings."""
    key = content_hash(asdict(settings), seed, source_files(), Path(__file__))
    folder = cache / f"{settings.split}-{seed}-{key}"
    if not (folder / ABOUT).is_file():
        for old in cache.glob(f"{settings.split}-{seed}-*"):
            shutil.rmtree(old)
        _make(settings, seed, folder)
    about = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
    points = torch.from_numpy(read_ply(folder / CLOUDS).points)
    parts = iter(points.split([count for visit in about["counts"] for count in visit]))
    visits = tuple(tuple(RigCloud(time, next(parts)) for time in visit) for visit in about["times_s"])
    scan = read_ply(folder / SCAN)
    return Session(
        RecordingFile(folder / RECORDING).load(), Scan(scan.points, scan.colors), visits, tuple(about["rig_error_m"])
    )


def _make(settings: SessionSettings, seed: int, folder: Path) -> None:
    """Simulate, scan, look with the rig; the note that makes it valid is written last."""
    simulated = simulate_hps(settings.config, f"{settings.split}-{seed}", settings.split, seed)
    recording, world = simulated.recording, simulated.world
    scan = scan_world(Scenery.of(world), settings.spacing_m, np.random.default_rng([31, seed]))
    assert recording.motion is not None
    assert recording.intervals is not None
    times = visit_times(recording.intervals, settings.instants)
    clouds, error_m = _rig_clouds(recording, world, scan, times, seed)
    save_recording(recording, folder / RECORDING)
    write_ply(Ply(scan.points, scan.colors), folder / SCAN)
    write_ply(Ply(np.concatenate(clouds).astype(np.float32)), folder / CLOUDS)
    counts = np.reshape([len(cloud) for cloud in clouds], times.shape).tolist()
    taken = recording.motion.timestamps[nearest_frames(recording.motion.timestamps, times.flatten())]
    about = {"times_s": taken.reshape(times.shape).tolist(), "counts": counts, "rig_error_m": error_m}
    write_text(folder / ABOUT, json.dumps(about) + "\n")


def _rig_clouds(
    recording: Recording, world: World, scan: Scan, times: torch.Tensor, seed: int
) -> tuple[list[np.ndarray], list[float]]:
    """The person's clouds at all instants in order, and how far off each camera was registered (m)."""
    motion, rng = recording.motion, np.random.default_rng([32, seed])
    assert motion is not None
    body = anny_body(motion.skeleton, recording.shape or None)
    frames = nearest_frames(motion.timestamps, times.flatten())
    vertices = body.vertices(motion.T_world_joint[frames]).numpy().astype(np.float32)
    faces = body.faces.numpy().astype(np.int32)
    spot = np.array(world.places.spots[0].position)
    true = place_rig(world, spot)
    people = [Mesh(v, faces, np.ones(3, np.float32)) for v in vertices]
    rig = simulate_rig([world.mesh], people, true, rng)
    near = scan.points[np.linalg.norm(scan.points - spot, axis=1) < RIG_SCENE_M]
    rough = approximate(true, rng)
    views = [
        DepthView(rig.camera, rough[number], Background.of(rig.empty_mm[number])).registered(near)[0]
        for number in range(len(true.t))
    ]
    clouds = [person_cloud(list(rig.depth_mm[:, number]), views) for number in range(len(frames))]
    thinned = [voxel_downsample(torch.from_numpy(cloud), CLOUD_VOXEL_M)[0].numpy() for cloud in clouds]
    return thinned, [float((view.T_world_cam.t - t).norm()) for view, t in zip(views, true.t)]


@dataclass(frozen=True)
class TrueClock:
    """The camera's clock against the suit's, as simulated."""

    offset_s: float
    rate: float
    claps_s: torch.Tensor
    """On the suit's clock."""

    @classmethod
    def of(cls, recording: Recording) -> "TrueClock":
        assert recording.motion is not None
        about = recording.motion.provenance
        claps = torch.tensor([float(time) for time in about["claps_s"].split()], dtype=torch.float64)
        rate = 1 + float(about["camera_clock_drift_ms_per_h"]) / 3.6e6
        return cls(float(about["camera_clock_offset_s"]), rate, claps)

    def to_camera(self, suit_s: torch.Tensor) -> torch.Tensor:
        return suit_s * self.rate + self.offset_s

    def heard_s(self, recording: Recording, seed: int) -> list[float]:
        """The claps that are detected in the camera's sound track, s from the first picture, as pipelines take them."""
        camera, track = recording.camera, recording.contacts
        assert camera is not None
        assert track is not None
        assert recording.motion is not None
        touching = track.contact.any(1)
        strikes = recording.motion.timestamps[1:][touching[1:] & ~touching[:-1]]
        first, last = camera.timestamps[0], camera.timestamps[-1]
        claps, steps = ((self.to_camera(times) - first).tolist() for times in (self.claps_s, strikes))
        sound = sound_track(float(last - first), claps, np.random.default_rng([33, seed]), steps)
        return detect_claps_audio(torch.from_numpy(sound), SOUND_HZ).tolist()

    def error_s(self, clock: Clock) -> float:
        """How far a found clock is off, at most, over the claps' span."""
        times = torch.linspace(0.0, float(self.claps_s[-1]), 50, dtype=torch.float64)
        return float((clock.to_suit(self.to_camera(times)) - times).abs().max())
