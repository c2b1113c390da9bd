"""A simulated calibration after MocapEvery's appendix C.2, with planted answers.

Watches on the board, T-pose, camera on four positions, standing, arm swings, then half a minute and more of walking.
The world is the board's: z up, y where the wearer faces, the floor at 0. The camera's clock is the true one.

Attitude: at rest Core Motion keeps it to 0.2-0.3°, wandering within some seconds; when moved, it errs by 1.5° more,
slowly (the project's usual watch). Errors that no procedure can detect are left out: a T-pose that is wrong by a
constant angle, and watches laid on the board askew. A pose's wobble and a stander's sway therefore average to zero
over the step.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.interpolate import CubicSpline
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, finite_difference, slerp
from wearcap.recording.recording import ImuStream
from wearcap.sensors.imu import GRAVITY, angular_rate
from wearcap.sensors.simulated import smooth_noise
from wearcap.sensors.stillness import Stretch
from wearsim.sensors.slam import R_DEVICE_CAM

BOARD, T_POSE, STANDING = (3.0, 6.5), (14.0, 17.5), (52.0, 62.0)
MARKS = ((24.0, 27.0), (30.0, 33.0), (36.0, 39.0), (42.0, 45.0))
SWINGS_S = 66.0
"""Time at which the arms begin to swing (s)."""
_MARGIN_S = 0.6
"""Additional time for which everything is kept still at both ends of a step."""
_MOVE_S = 1.5
"""Duration of the transition from one step to the next."""
_FINER = 6
"""Oversampling of the camera's path relative to its frames: a second difference at 60 Hz misses 0.4 % of a gait."""
_FACING = rotation.about_axis("z", torch.tensor(math.pi / 2, dtype=torch.float64))


@dataclass(frozen=True)
class SessionNoise:
    """Errors of the sensors and unsteadiness of the wearer."""

    still: tuple[float, float] = (0.25, 2.0)
    """Deviation (deg) and period (s) of the attitude's error at rest."""
    moving: tuple[float, float] = (1.5, 8.0)
    """Deviation (deg) and period (s) of its additional error when moved."""
    acc_noise: float = 0.04
    acc_bias: float = 0.02
    wobble_deg: float = 1.5
    sway_deg: float = 0.6
    jitter_m: float = 0.0015
    jitter_deg: float = 0.12
    jitter_period_s: float = 0.4
    clock: tuple[float, float] = (0.3, 50.0)
    """Largest offset (s) and deviation of the rate (ppm) of the watches' clocks."""


@dataclass(frozen=True)
class _Measured:
    """Lengths that the wearer measures (m)."""

    distances_m: tuple[float, float]
    mark_height_m: float
    standing_m: float
    """Height of the camera above the floor while standing."""


@dataclass(frozen=True)
class _Planted:
    """The answers that a calibration should find."""

    R_world_ref: dict[str, Tensor]
    R_joint_imu: dict[str, Tensor]
    R_world_slam: Float64[Tensor, "3 3"]
    t_world_slam: Float64[Tensor, "3"]
    scale: float
    R_head_cam: Float64[Tensor, "3 3"]
    offset_s: dict[str, float]
    """Camera clock minus watch clock when the arms begin to swing."""


@dataclass(frozen=True)
class CalibrationSession:
    """The recorded session and the times of its steps."""

    watches: dict[str, ImuStream]
    """Logs of the watches, each in its own reference frame and on its own clock."""
    slam: Trajectory
    """Camera poses (OpenCV) in the SLAM's world and unit, on the camera's clock."""
    head_imu: ImuStream
    """IMU fixed to the camera, in its axes, on its clock."""
    points_slam: Float[Tensor, "point 3"]
    swings_s: Float64[Tensor, "swing"]
    """Times on the camera's clock at which the hands are nearest."""
    board: dict[str, Stretch]
    t_pose: dict[str, Stretch]
    measured: _Measured
    planted: _Planted


def simulate_calibration(
    seed: int,
    noise: SessionNoise = SessionNoise(),
    camera_fps: float = 60.0,
    watch_fps: float = 100.0,
    walk_s: float = 60.0,
    swings: int = 10,
) -> CalibrationSession:
    """Simulate one session; everything is drawn from `seed`."""
    rng = np.random.default_rng(seed)
    tops = SWINGS_S + 0.8 + np.cumsum(rng.normal(1.35, 0.12, swings).clip(1.0, 1.7))
    end = tops[-1] + 3 + walk_s
    watches = {joint: _watch(joint, tops, watch_fps, end, noise, rng) for joint in ("left_wrist", "right_wrist")}
    scale = float(np.exp(rng.normal(0.7, 0.8)))
    R_world_slam, t_world_slam = _turn(rng, math.pi), torch.from_numpy(rng.normal(0, 2, 3))
    pitch = rotation.about_axis("x", torch.tensor(-math.radians(rng.uniform(5, 25)), dtype=torch.float64))
    R_head_cam = R_DEVICE_CAM.double() @ pitch @ _turn(rng, math.radians(4))
    distances, height = (float(rng.uniform(0.4, 0.7)), float(rng.uniform(0.4, 0.7))), float(rng.uniform(0.7, 1.0))
    T_world_cam = _camera_path(R_head_cam, distances, height, end, _FINER * camera_fps, noise, rng)
    slam = _seen(T_world_cam[::_FINER], scale, R_world_slam, t_world_slam, camera_fps, noise, rng)
    upright = (T_world_cam.timestamps >= STANDING[0]) & (T_world_cam.timestamps <= STANDING[1])
    # a semi-dense cloud (m, world): floor, a table, walls, and some points that are wrong
    low, high = np.array([-8.0, -8.0]), np.array([8.0, 12.0])
    floor = np.concatenate([rng.uniform(low, high, (3000, 2)), np.zeros((3000, 1))], 1)
    table = np.concatenate([rng.uniform([-0.5, -0.3], [1.0, 1.0], (800, 2)), np.full((800, 1), 0.74)], 1)
    wall = np.stack([rng.uniform(-8, 8, 3000), np.full(3000, 6.0), rng.uniform(0, 2.6, 3000)], -1)
    points = np.concatenate([floor, table, wall])
    points = points + 0.012 * rng.standard_normal(points.shape)
    wrong = rng.random(len(points)) < 0.03
    points[wrong] += rng.normal(0, 0.4, (int(wrong.sum()), 3))
    points_slam = (torch.from_numpy(points) - t_world_slam) @ R_world_slam / scale
    logs, R_world_ref, R_joint_imu, clocks = (dict(zip(watches, made)) for made in zip(*watches.values()))
    return CalibrationSession(
        logs,
        slam,
        _head_imu(T_world_cam, watch_fps, noise, rng),
        points_slam.float(),
        torch.from_numpy(np.round(tops * camera_fps) / camera_fps),
        *({joint: (clock(start), clock(stop)) for joint, clock in clocks.items()} for start, stop in (BOARD, T_POSE)),
        _Measured(distances, height, T_world_cam.t_world_body[upright, 2].mean().item()),
        _Planted(
            R_world_ref,
            R_joint_imu,
            R_world_slam,
            t_world_slam,
            scale,
            R_head_cam,
            {joint: -clock(SWINGS_S) + SWINGS_S for joint, clock in clocks.items()},
        ),
    )


def _turn(rng: np.random.Generator, angle: float) -> Float64[Tensor, "3 3"]:
    """A rotation about a random axis by up to `angle` (rad)."""
    axis = rng.standard_normal(3)
    return rotation.exp(torch.from_numpy(axis / np.linalg.norm(axis) * angle * rng.uniform(0.3, 1)))


def _held(time: np.ndarray, holds: list[tuple[float, float]]) -> np.ndarray:
    """Index among the holds (start s, stop s): whole numbers during a hold, a minimum-jerk step in between."""
    place = np.zeros(len(time))
    for (_, left), (arrived, _) in pairwise(holds):
        begin = max(left, arrived - _MOVE_S)
        u = ((time - begin) / (arrived - begin)).clip(0, 1)
        place += u**3 * (10 - 15 * u + 6 * u**2)
    return place


def _between(keys: Float64[Tensor, "key 3 3"], place: np.ndarray) -> Float64[Tensor, "time 3 3"]:
    """Rotations at fractional indices among keys."""
    return slerp(torch.arange(len(keys), dtype=torch.float64), keys, torch.from_numpy(place))


def _centred(wobble: Tensor, time: np.ndarray, stretch: Stretch) -> Tensor:
    """The part of a disturbance that averages out over a step, with a smooth beginning and end."""
    inside = (time >= stretch[0]) & (time <= stretch[1])
    edge = np.minimum(time - stretch[0] + _MARGIN_S, stretch[1] + _MARGIN_S - time) / _MARGIN_S
    return (wobble - wobble[torch.from_numpy(inside)].mean(0)) * torch.from_numpy(edge.clip(0, 1))[:, None]


def _arm(joint: str, tops: np.ndarray, time: np.ndarray, noise: SessionNoise, rng: np.random.Generator) -> Tensor:
    """R_world_joint of a wrist: T-pose, hanging, swinging, hanging while walking with a swing of 20°."""
    side = 1.0 if joint.startswith("left") else -1.0
    fps = 1 / (time[1] - time[0])
    quarter = torch.tensor(-side * math.pi / 2, dtype=torch.float64)
    hanging = rotation.about_axis("x", quarter)
    place = _held(time, [(0.0, T_POSE[1] + _MARGIN_S), (T_POSE[1] + 3, np.inf)])
    posed = _between(torch.stack([torch.eye(3, dtype=torch.float64), hanging]), place)
    stepping = ((time - tops[-1] - 3) / 0.5).clip(0, 1) * np.deg2rad(20) * np.sin(2 * np.pi * 0.95 * time)
    # The arm's elevation: hanging (even phases of the knots), and up at each of `tops`, with the hand before the head.
    middles = np.concatenate([[2 * tops[0] - tops[1]], tops, [2 * tops[-1] - tops[-2]]])
    knots = np.sort(np.concatenate([tops, (middles[1:] + middles[:-1]) / 2]))
    phase = CubicSpline(knots, np.arange(len(knots)))(time.clip(knots[0], knots[-1]))
    high = np.deg2rad(rng.uniform(40, 65))
    elevation = -np.pi / 2 + (high + np.pi / 2) * 0.5 * (1 - np.cos(np.pi * phase))
    raised = elevation + np.pi / 2 + stepping
    swung = rotation.about_axis("y", torch.from_numpy(-raised))
    wobble = smooth_noise(rng, len(time), 3, 0.8, fps).double() * np.deg2rad(noise.wobble_deg) / np.sqrt(3)
    return _FACING @ swung @ posed @ rotation.exp(_centred(wobble, time, T_POSE))


def _watch(
    joint: str, tops: np.ndarray, fps: float, end: float, noise: SessionNoise, rng: np.random.Generator
) -> tuple[ImuStream, Tensor, Tensor, Callable[[float], float]]:
    """A watch's log, R_world_ref, R_joint_imu, and what its clock shows at a true time."""
    time = np.arange(0, end, 1 / fps)
    crown = 90.0 if joint.startswith("left") or rng.random() < 0.5 else -90.0
    R_joint_imu = rotation.about_axis("z", torch.tensor(math.radians(crown), dtype=torch.float64)) @ _turn(
        rng, math.radians(8)
    )
    R_world_ref = rotation.about_axis("z", torch.tensor(rng.uniform(-math.pi, math.pi), dtype=torch.float64))
    R_world_joint = _arm(joint, tops, time, noise, rng)
    worn = _held(time, [(0.0, BOARD[1] + _MARGIN_S), (T_POSE[0] - _MARGIN_S, np.inf)])
    # From the board, where the watch's axes are the world's, onto the arm
    R_world_imu = R_world_joint @ R_joint_imu
    home = rotation.log(R_world_imu.mT) * torch.from_numpy(1 - worn)[:, None]
    R_world_imu = R_world_imu @ rotation.exp(home)
    side = 1.0 if joint.startswith("left") else -1.0
    reach = torch.tensor([0.0, 0.55 * side, 0.0], dtype=torch.float64)
    position = (R_world_joint @ reach) * torch.from_numpy(worn)[:, None]
    # Core Motion's log in its reference frame: attitude that errs more when moved, and the measured acceleration.
    step_fps = 1 / (time[1] - time[0])
    R, times = R_world_imu, torch.from_numpy(time)
    acc = finite_difference(finite_difference(position, times), times).roll(-1, 0)
    up = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)
    felt = (R.mT @ (acc + up)[..., None])[..., 0] + torch.from_numpy(
        noise.acc_bias * rng.standard_normal(3) + noise.acc_noise * rng.standard_normal((len(time), 3))
    )
    rate = angular_rate(R, step_fps)
    turning = np.convolve(rate.norm(dim=-1).numpy(), np.ones(int(step_fps)) / step_fps, "same")
    # Slower than 0.2 rad/s on average counts as rest for the filter.
    moved = torch.from_numpy((turning - 0.2).clip(0, 1))
    error = noise.still[0] * smooth_noise(rng, len(time), 3, noise.still[1], step_fps).double()
    error += noise.moving[0] * smooth_noise(rng, len(time), 3, noise.moving[1], step_fps).double() * moved[:, None]
    R_ref_imu = R_world_ref.mT @ R @ rotation.exp(torch.deg2rad(error) / np.sqrt(3))
    acc_ref = (R_ref_imu @ felt[..., None])[..., 0] - up
    offset, clock_rate = rng.uniform(-1, 1) * noise.clock[0], 1 + 1e-6 * noise.clock[1] * rng.standard_normal()

    def clock(true_s: float) -> float:
        return 1.7e9 + offset + clock_rate * true_s

    times = torch.tensor([clock(t) for t in time.tolist()], dtype=torch.float64)
    log = ImuStream(times, joint, R_ref_imu.float(), acc_ref.float(), felt.float(), rate.float())
    return log, R_world_ref, R_joint_imu, clock


def _camera_path(
    R_head_cam: Tensor,
    distances: tuple[float, float],
    height: float,
    end: float,
    fps: float,
    noise: SessionNoise,
    rng: np.random.Generator,
) -> Trajectory:
    """True poses of the camera: on the board's four positions, then on the head of someone who stands and walks."""
    time = np.arange(0, end, 1 / fps)
    y, x = rng.uniform(0.05, 0.15, 2)
    marks = [[0, y, height], [0, y + distances[0], height], [x, 0, height], [x + distances[1], 0, height]]
    head_t = torch.tensor([-0.4, -0.9, rng.uniform(1.45, 1.65)], dtype=torch.float64)
    sway = _centred(smooth_noise(rng, len(time), 6, 2.5, fps).double(), time, STANDING)
    R_head, t_head = _walk(time, end, head_t, rng)
    R_head = R_head @ rotation.exp(sway[:, :3] * np.deg2rad(noise.sway_deg) / np.sqrt(3))
    T_world_cam = Rigid(R_head, t_head + 0.004 * sway[:, 3:]) @ Rigid(
        R_head_cam, torch.tensor([0.09, 0.0, 0.09]).double()
    )
    on_board = _FACING @ R_DEVICE_CAM.double() @ _turn(rng, math.radians(5))
    turned = [on_board @ rotation.about_axis("y", torch.tensor(a).double()) for a in (0.0, 0.5, 0.1, 0.6)]
    holds = [(a - _MARGIN_S, b + _MARGIN_S) for a, b in MARKS]
    place = _held(time, [*holds, (MARKS[-1][1] + 4, np.inf)])
    R = _between(torch.stack([*turned, T_world_cam.R[0]]), place)
    t = torch.stack(
        [torch.from_numpy(np.interp(place, range(5), column)) for column in zip(*marks, T_world_cam.t[0].tolist())], -1
    )
    worn = torch.from_numpy(time >= MARKS[-1][1] + 4)[:, None]
    return Trajectory(
        torch.from_numpy(time), torch.where(worn[..., None], T_world_cam.R, R), torch.where(worn, T_world_cam.t, t)
    )


def _walk(time: np.ndarray, end: float, standing: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Head poses: standing (facing y), then loops of an uneven eight with a walker's bob and looking around."""
    start = SWINGS_S + 17
    along = (time - start).clip(0)
    speed = 1.1 * np.minimum(along / 2, 1)
    arc = np.cumsum(speed * (1 + 0.15 * np.sin(0.4 * time))) * (time[1] - time[0])
    heading = np.pi / 2 + 1.9 * np.sin(arc / 1.6) + 0.35 * np.minimum(arc / 3, 1) * arc / 3
    step = np.stack([np.cos(heading), np.sin(heading)], -1) * np.gradient(arc)[:, None]
    ground = np.cumsum(step, 0)
    walking = speed / 1.1
    stride = 2 * np.pi * (0.95 * along)
    bob = 0.022 * np.sin(2 * stride + rng.uniform(0, 6)) * walking
    lateral = 0.02 * np.sin(stride) * walking
    t = np.stack([ground[:, 0] - lateral * np.sin(heading), ground[:, 1] + lateral * np.cos(heading), bob], -1)
    fps = 1 / (time[1] - time[0])
    look = smooth_noise(rng, len(time), 3, 3.0, fps).double().numpy() * walking[:, None] * np.deg2rad([4, 9, 16])
    R = rotation.about_axis("z", torch.from_numpy(heading + look[:, 2]))
    R = (
        R
        @ rotation.about_axis("y", torch.from_numpy(look[:, 1]))
        @ rotation.about_axis("x", torch.from_numpy(look[:, 0]))
    )
    return R, standing + torch.from_numpy(t)


def _seen(
    T: Trajectory,
    scale: float,
    R_world_slam: Tensor,
    t_world_slam: Tensor,
    fps: float,
    noise: SessionNoise,
    rng: np.random.Generator,
) -> Trajectory:
    """The path as a monocular SLAM reports it."""
    jitter = smooth_noise(rng, len(T), 6, noise.jitter_period_s, fps).double()
    R = T.R_world_body @ rotation.exp(np.deg2rad(noise.jitter_deg) * jitter[:, :3])
    t = T.t_world_body + noise.jitter_m * jitter[:, 3:]
    t_slam = (t - t_world_slam) @ R_world_slam / scale
    return Trajectory(T.timestamps.contiguous(), (R_world_slam.mT @ R).float(), t_slam.float())


def _head_imu(T: Trajectory, fps: float, noise: SessionNoise, rng: np.random.Generator) -> ImuStream:
    """A sensor within the camera: specific force and turn rate at its own rate, from when the camera is put on."""
    worn = T[T.timestamps > MARKS[-1][1] + 5]
    times = worn.timestamps
    acc = finite_difference(finite_difference(worn.t_world_body, times), times).roll(-1, 0)
    felt = (worn.R_world_body.mT @ (acc + torch.tensor([0.0, 0.0, GRAVITY]).double())[..., None])[..., 0]
    at = np.arange(times[2].item(), times[-3].item(), 1 / fps)
    felt = np.stack([np.interp(at, times.numpy(), felt[:, axis].numpy()) for axis in range(3)], -1)
    felt = felt + noise.acc_bias * rng.standard_normal(3) + noise.acc_noise * rng.standard_normal(felt.shape)
    return ImuStream(torch.from_numpy(at), "head", acc_imu=torch.from_numpy(felt).float())
