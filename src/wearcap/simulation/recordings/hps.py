"""One simulated HPS recording: a long session in a site, recorded by a suit, wrist sensors and a head camera."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ContactTrack, FloorTrack, ImuStream, Recording
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearcap.sensors.suit import SuitNoise, suit_motion
from wearcap.simulation.places.world import World
from wearcap.simulation.recordings.hps_session import Protocol, SimulatedSession, simulate_session
from wearcap.simulation.recordings.localization_noise import LocalizationNoise, localize_statistically
from wearcap.simulation.recordings.simulate import POOLS, person_of, world_of
from wearcap.simulation.rendering.head_camera import HEAD_CAMERA_TRUTH, HeadCameraConfig, head_camera, view_texture

CLAP_WIDTH_S = 0.011
"""Deviation of the shock of two palms, as a wrist's sensor measures it."""
SITES = {"train": 8, "val": 3, "test": 5}
"""Sites of each split, fewer than flats: each needs a scan and photos."""


@dataclass(frozen=True)
class HpsConfig(HeadCameraConfig):
    """Settings of a simulated recording."""

    fps: float = 60.0
    """Frame rate of suit and wrist sensors."""
    protocol: Protocol = field(default_factory=Protocol)
    suit: SuitNoise = field(default_factory=SuitNoise)
    imu: ImuNoise = field(default_factory=ImuNoise)
    localization: LocalizationNoise | None = field(default_factory=LocalizationNoise)
    """Noise of the localisation; None: it is to be found from the video."""
    clap_acc: tuple[float, float] = (30.0, 60.0)
    """Range of the palms' shock (m/s²)."""

    def __post_init__(self):
        super().__post_init__()
        if self.fps < 30:
            raise WearcapError(f"{self.fps} Hz of the suit", expected="30 Hz or more")


@dataclass(frozen=True)
class Simulated:
    """A recording, and the world and session that it was made from."""

    recording: Recording
    session: SimulatedSession
    world: World
    clock: tuple[float, float]
    """Clock of the camera: its lead over the suit's at the suit's zero (s), and its drift (ms per hour)."""

    def to_camera(self, suit_s: float) -> float:
        """Time of the camera's clock at a time of the suit's."""
        return suit_s * (1 + self.clock[1] / 3.6e6) + self.clock[0]


def site_number(split: str, index: int) -> int:
    """Number of the split's site in which its index-th recording takes place."""
    return index % min(SITES[split], POOLS[split][1])


def simulate_hps(config: HpsConfig, name: str, split: str, seed: int, world: World | None = None) -> Simulated:
    """The recording of a seed; without a world, in the split's site of the same number.

    Streams of the suit run on its clock, the camera's and its localisation on the camera's. True are `motion`,
    `contacts`, `floor`, `intervals` ("stand" and "move" at the capture spot, by distance travelled), the camera's
    poses (`HEAD_CAMERA_TRUTH`); and in the motion's provenance the clock's offset and drift and the claps' times.
    """
    rng = np.random.default_rng([5, sum(map(ord, split)), seed])
    person = person_of(split, int(rng.integers(POOLS[split][0])))
    world = world or world_of(split, site_number(split, seed), "site")
    session = simulate_session(world, person, rng, config.fps, config.protocol)
    motion = session.simulated.motion
    suit = suit_motion(motion, session.simulated.contact, config.suit, rng)
    strength = rng.uniform(*config.clap_acc, len(session.claps_s))
    imu = {f"{side}_wrist": _wrist(motion, side, config, session.claps_s, strength, rng) for side in ("left", "right")}
    camera, path, clock = head_camera(motion, person.t_head_device, config, rng)
    localization = None
    if config.localization is not None:
        texture = view_texture(world, path, max(1, round(config.camera_fps / 2)))
        localization = localize_statistically(path, config.localization, rng, texture)
    about = {
        "claps_s": " ".join(f"{time:.4f}" for time in session.claps_s),
        "camera_clock_offset_s": f"{clock[0]:.6f}",
        "camera_clock_drift_ms_per_h": f"{clock[1]:.3f}",
    }
    recording = Recording(
        name,
        imu=imu,
        suit=suit,
        camera=camera,
        localization=localization,
        motion=replace(motion, provenance=motion.provenance | about),
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, session.simulated.contact),
        object_motion={HEAD_CAMERA_TRUTH: path},
        floor=FloorTrack(motion.timestamps, session.simulated.floor_height),
        intervals=session.intervals,
        skeleton=person.skeleton,
        shape=person.shape,
        subject=person.name,
        location=world.name,
        activity="session",
        source="wearcap simulation",
        license="MIT (generated)",
    )
    return Simulated(recording, session, world, clock)


def _wrist(
    motion: Motion,
    side: str,
    config: HpsConfig,
    claps_s: tuple[float, ...],
    strength: np.ndarray,
    rng: np.random.Generator,
) -> ImuStream:
    """Readings of a wrist's sensor; palms that meet push the wrists apart for some hundredths of a second."""
    stream = synthesize_imu(motion, f"{side}_wrist", noise=config.imu, rng=rng, n=1)
    apart = motion.joint(f"{side}_wrist").t - motion.joint("right_wrist" if side == "left" else "left_wrist").t
    apart = apart / apart.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    times = stream.timestamps[:, None] - torch.tensor(claps_s, dtype=torch.float64)
    pulse = (torch.exp(-0.5 * (times / CLAP_WIDTH_S) ** 2) * torch.from_numpy(strength)).sum(1).float()
    shock = pulse[:, None] * apart
    assert stream.acc_world is not None
    assert stream.acc_imu is not None
    R = motion.joint(f"{side}_wrist").R
    return replace(
        stream,
        acc_world=stream.acc_world + shock,
        acc_imu=stream.acc_imu + (R.transpose(-1, -2) @ shock[..., None])[..., 0],
    )
