"""One simulated HPS recording: a long session in a site, seen by a suit, wrist sensors and a head camera."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry import raster, rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream, ContactTrack, FloorTrack, ImuStream, Recording
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearcap.sensors.slam import R_DEVICE_CAM
from wearcap.sensors.suit import SuitNoise, suit_motion
from wearcap.simulation.hps_session import Protocol, SimulatedSession, simulate_session
from wearcap.simulation.localization_noise import LocalizationNoise, localize_statistically
from wearcap.simulation.simulate import POOLS, person_of, world_of
from wearcap.simulation.world import World

HEAD_CAMERA = Camera(
    "opencv", 1920, 1080, 871.80, 885.58, 961.54, 550.69, (-0.2546, 0.0804, 1.458e-4, -1.397e-5)
).scaled(960, 540)
"""The HPS data set's head camera at half its size."""
HEAD_CAMERA_TRUTH = "head_camera"
"""Entry of `Recording.object_motion` with the camera's true poses, on the camera's own clock."""
CLAP_WIDTH_S = 0.011
"""Deviation of the shock of two palms, as a wrist's sensor passes it on."""
SITES = {"train": 8, "val": 3, "test": 5}
"""Sites of each split, fewer than flats: each needs a scan and photos."""


@dataclass(frozen=True)
class HpsConfig:
    """What to simulate."""

    fps: float = 60.0
    """Of suit and wrist sensors."""
    camera_fps: float = 30.0
    protocol: Protocol = field(default_factory=Protocol)
    suit: SuitNoise = field(default_factory=SuitNoise)
    imu: ImuNoise = field(default_factory=ImuNoise)
    localization: LocalizationNoise | None = field(default_factory=LocalizationNoise)
    """None: to be found in the video."""
    clock_offset_s: float = 4.0
    """Largest lead of the camera's clock over the suit's, or lag."""
    clock_drift_ms_per_h: tuple[float, float] = (87.0, 12.0)
    """Mean and deviation over recordings of what the camera's clock gains."""
    mount_deg: float = 4.0
    mount_m: float = 0.008
    """Deviations of how the camera sits on the head from its nominal mount."""
    clap_acc: tuple[float, float] = (30.0, 60.0)
    """Of the palms' shock (m/s²)."""

    def __post_init__(self):
        if self.fps < 30 or self.camera_fps <= 0:
            raise WearcapError(
                f"{self.fps} Hz of the suit, {self.camera_fps} Hz of the camera", expected="30 Hz or more, and more than 0",
            )  # fmt: skip


@dataclass(frozen=True)
class Simulated:
    """A recording, and what made it."""

    recording: Recording
    session: SimulatedSession
    world: World
    clock: tuple[float, float]
    """The camera's: lead over the suit's at its zero (s), and what it gains (ms per hour)."""

    def to_camera(self, suit_s: float) -> float:
        """The camera's time at a time of the suit."""
        return suit_s * (1 + self.clock[1] / 3.6e6) + self.clock[0]


def site_number(split: str, index: int) -> int:
    """Which of a split's sites its index-th recording takes place in."""
    return index % min(SITES[split], POOLS[split][1])


def simulate_hps(
    config: HpsConfig, name: str, split: str, seed: int, world: World | None = None
) -> Simulated:
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
    imu = {f"{side}_wrist": _wrist(motion, side, config, session.claps_s, strength, rng)
           for side in ("left", "right")}  # fmt: skip
    camera, path, clock = _head_camera(motion, person.t_head_device, config, rng)
    localization = None
    if config.localization is not None:
        every = max(1, round(config.camera_fps / 2))
        texture = view_texture(world, path, every)
        localization = localize_statistically(path, config.localization, rng, texture)
    about = {
        "claps_s": " ".join(f"{time:.4f}" for time in session.claps_s),
        "camera_clock_offset_s": f"{clock[0]:.6f}", "camera_clock_drift_ms_per_h": f"{clock[1]:.3f}",
    }  # fmt: skip
    recording = Recording(
        name, imu=imu, suit=suit, camera=camera, localization=localization,
        motion=replace(motion, provenance=motion.provenance | about),
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, session.simulated.contact),
        object_motion={HEAD_CAMERA_TRUTH: path}, floor=FloorTrack(motion.timestamps, session.simulated.floor_height),
        intervals=session.intervals, skeleton=person.skeleton, shape=person.shape, subject=person.name,
        location=world.name, activity="session", source="wearcap simulation", license="MIT (generated)",
    )  # fmt: skip
    return Simulated(recording, session, world, clock)


def _wrist(
    motion: Motion, side: str, config: HpsConfig, claps_s: tuple[float, ...], strength: np.ndarray,
    rng: np.random.Generator,
) -> ImuStream:  # fmt: skip
    """A wrist's sensor; palms that meet push the wrists apart for some hundredths of a second."""
    stream = synthesize_imu(motion, f"{side}_wrist", noise=config.imu, rng=rng, n=1)
    apart = (
        motion.joint(f"{side}_wrist").t - motion.joint("right_wrist" if side == "left" else "left_wrist").t
    )
    apart = apart / apart.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    times = stream.timestamps[:, None] - torch.tensor(claps_s, dtype=torch.float64)
    pulse = (torch.exp(-0.5 * (times / CLAP_WIDTH_S) ** 2) * torch.from_numpy(strength)).sum(1).float()
    shock = pulse[:, None] * apart
    assert stream.acc_world is not None
    assert stream.acc_imu is not None
    R = motion.joint(f"{side}_wrist").R
    return replace(
        stream, acc_world=stream.acc_world + shock,
        acc_imu=stream.acc_imu + (R.transpose(-1, -2) @ shock[..., None])[..., 0],
    )  # fmt: skip


def _head_camera(
    motion: Motion, t_head_device: Float[Tensor, "3"], config: HpsConfig, rng: np.random.Generator
) -> tuple[CameraStream, Trajectory, tuple[float, float]]:
    """The stream with its nominal mount, the true poses on its clock, and that clock's offset (s) and drift (ms/h)."""
    offset = float(rng.uniform(-1, 1)) * config.clock_offset_s
    drift = float(rng.normal(*config.clock_drift_ms_per_h))
    rate = 1 + drift / 3.6e6
    turn = np.deg2rad(config.mount_deg) * rng.standard_normal(3) / np.sqrt(3)
    R_mount = rotation.exp(torch.from_numpy(turn).float()) @ R_DEVICE_CAM
    t_mount = t_head_device + torch.from_numpy(config.mount_m * rng.standard_normal(3)).float()
    T_world_head = motion.joint("head")
    T_world_cam = T_world_head @ Rigid(R_mount, t_mount)[None]
    true = Trajectory(motion.timestamps, T_world_cam.R, T_world_cam.t)
    start, stop = motion.timestamps[0].item(), motion.timestamps[-1].item()
    first = start * rate + offset + float(rng.uniform(0.0, 1 / config.camera_fps))
    count = int((stop * rate + offset - first) * config.camera_fps)
    times = first + torch.arange(count, dtype=torch.float64) / config.camera_fps
    at = resample(true, ((times - offset) / rate).clamp(start, stop))
    stream = CameraStream(times, HEAD_CAMERA, R_DEVICE_CAM, torch.tensor([0.09, 0.0, 0.09]))
    return stream, Trajectory(times, at.R_world_body, at.t_world_body), (offset, drift)


_GLANCE = Camera("pinhole", 48, 27, 22.0, 22.0, 23.5, 13.0)


def view_texture(world: World, path: Trajectory, every: int = 15) -> Float[Tensor, "time"]:
    """How much there is to see in a camera's frames: the mean texture grade (features per m²) in view.

    Every n-th frame is looked at, those between are interpolated.
    """
    frames = np.arange(0, len(path.timestamps), every)
    grade = np.append(np.minimum(world.face_texture, 60.0), 3.0)  # the sky shows roofs and trees now and then
    seen = np.empty(len(frames))
    R, t = path.R_world_body.double().numpy(), path.t_world_body.double().numpy()
    for row, frame in enumerate(frames):
        nearness = np.full((_GLANCE.height, _GLANCE.width), -np.inf, np.float32)
        index = np.full((_GLANCE.height, _GLANCE.width), -1, np.int32)
        raster.draw_pinhole((world.mesh.vertices - t[frame]) @ R[frame], world.mesh.faces, _GLANCE.fx, _GLANCE.fy,
                            _GLANCE.cx, _GLANCE.cy, 0.03, nearness, index)  # fmt: skip
        seen[row] = grade[index].mean()
    return torch.from_numpy(np.interp(np.arange(len(path.timestamps)), frames, seen)).float()
