"""Inertial sensors on a moving body (MocapEvery eq. 8), perfect or with the errors of real ones."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ImuStream
from wearcap.sensors.simulated import heading_walk, smooth_noise

GRAVITY = 9.81
"""m/s², downwards along the world's z."""

ATTITUDE_PERIOD_S = 8.0


@dataclass(frozen=True)
class ImuNoise:
    """Errors of a watch-like sensor; zeros make it perfect."""

    attitude_deg: float = 1.5
    """Error of the attitude, which varies over `ATTITUDE_PERIOD_S`."""
    heading_walk_deg_per_sqrt_min: float = 1.0
    acc_noise: float = 0.04
    """White noise of each axis (m/s²)."""
    acc_bias: float = 0.02
    gyro_noise_deg_s: float = 0.3
    strap_deg: float = 3.0
    """Constant mounting error."""
    clock_offset_s: float = 0.0
    """Largest offset of the sensor's clock, drawn uniformly."""
    clock_ppm: float = 0.0
    play_deg: float = 0.0
    """Largest angle by which the strap gives under the arm's acceleration."""
    heading_deg: float = 0.0
    """Deviation of the heading of the sensor's own world from the start, which calibration leaves."""


PUSHED = 8.0
"""Acceleration (m/s²) at which a strap has given three quarters of the most that it can."""


def acceleration(position: Float[Tensor, "time axis"], fps: float, n: int = 4) -> Float[Tensor, "time axis"]:
    """(p[t-n] + p[t+n] - 2 p[t]) / (n Δt)² (MocapEvery eq. 8); the ends repeat the nearest frame that has both.

    Shorter recordings than 2n + 1 frames have none: zero.
    """
    if len(position) <= 2 * n:
        return torch.zeros_like(position)
    p = position.double()
    inner = (p[: -2 * n] + p[2 * n :] - 2 * p[n:-n]) * (fps / n) ** 2
    return torch.cat([inner[:1].expand(n, -1), inner, inner[-1:].expand(n, -1)]).to(position.dtype)


def mean_filter(value: Float[Tensor, "time feature"], window: int = 7) -> Float[Tensor, "time feature"]:
    """Centred mean over an odd number of frames, edges repeated (MocapEvery: 7, on real and synthetic data)."""
    half = window // 2
    padded = torch.cat([value[:1].expand(half, -1), value, value[-1:].expand(half, -1)])
    return padded.unfold(0, window, 1).mean(-1)


def angular_rate(R_world_imu: Float[Tensor, "time 3 3"], fps: float) -> Float[Tensor, "time 3"]:
    """Angular velocity in the sensor's axes (rad/s), from each frame to the next; the last repeats."""
    step = rotation.log(R_world_imu[:-1].transpose(-1, -2) @ R_world_imu[1:]) * fps
    return torch.cat([step, step[-1:]]) if len(step) else torch.zeros(len(R_world_imu), 3)


def synthesize_imu(
    motion: Motion,
    joint: str,
    *,
    R_joint_imu: Float[Tensor, "3 3"] | None = None,
    noise: ImuNoise | None = None,
    rng: np.random.Generator | None = None,
    n: int = 4,
) -> ImuStream:
    """What a sensor fixed to a joint measures: orientation, free acceleration, specific force, angular rate.

    The sensor sits at the joint; its axes default to the joint's own. With `noise`, `rng` draws attitude error, heading
    drift, bias, white noise, a loose strap and a clock that is off. Nothing is filtered: see `mean_filter`.
    """
    T_world_joint = motion.joint(joint)
    R_joint_imu = torch.eye(3) if R_joint_imu is None else R_joint_imu
    gravity = torch.tensor([0.0, 0.0, GRAVITY])
    worn = R_joint_imu
    if noise is not None:
        assert rng is not None, "noise needs a generator"
        strap = np.deg2rad(noise.strap_deg) * rng.standard_normal(3) / np.sqrt(3)
        worn = R_joint_imu @ rotation.exp(torch.from_numpy(strap).float())
    fps, times = motion.fps, motion.timestamps
    R_world_imu = T_world_joint.R @ worn
    if noise is not None and rng is not None and noise.play_deg:
        pushed = mean_filter((R_world_imu.mT @ acceleration(T_world_joint.t, fps, n)[..., None])[..., 0], 3)
        sideways, axis = torch.nn.functional.normalize(_normal(rng, 2, 3), dim=-1)
        gives = torch.tanh((pushed @ sideways)[:, None] / PUSHED) * axis
        R_world_imu = R_world_imu @ rotation.exp(np.deg2rad(noise.play_deg) * gives)
    path = Trajectory(times, R_world_imu, T_world_joint.t)
    if noise is not None and rng is not None and (noise.clock_offset_s or noise.clock_ppm):
        # The path is sampled when the sensor's clock shows the recording's timestamps.
        offset = float(rng.uniform(-1, 1)) * noise.clock_offset_s
        rate = 1 + 1e-6 * noise.clock_ppm * float(rng.standard_normal())
        true = times[0] + (times - times[0]) * rate - offset
        path = resample(path, true.clamp(times[0].item(), times[-1].item()))
    R, acc_world = path.R_world_body, acceleration(path.t_world_body, fps, n)
    gyro = angular_rate(R, fps)
    acc_imu = (R.transpose(-1, -2) @ (acc_world + gravity)[..., None])[..., 0]
    if noise is not None:
        acc_imu = acc_imu + _normal(rng, 1, 3) * noise.acc_bias + _normal(rng, len(R), 3) * noise.acc_noise
        gyro = gyro + _normal(rng, len(R), 3) * np.deg2rad(noise.gyro_noise_deg_s)
        # The sensor estimates its orientation with a slowly varying attitude error and a drifting heading.
        attitude = smooth_noise(rng, len(R), 3, ATTITUDE_PERIOD_S, fps)
        attitude = np.deg2rad(noise.attitude_deg) * attitude / np.sqrt(3)
        heading = heading_walk(rng, len(R), noise.heading_walk_deg_per_sqrt_min, fps)
        if noise.heading_deg:
            heading = rotation.about_axis("z", np.deg2rad(noise.heading_deg) * _normal(rng, 1))[0] @ heading
        R = heading @ R @ rotation.exp(attitude)
        acc_world = (R @ acc_imu[..., None])[..., 0] - gravity
    return ImuStream(times, joint, R, acc_world, acc_imu, gyro, R_joint_imu)


def _normal(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.from_numpy(rng.standard_normal(shape)).float()
