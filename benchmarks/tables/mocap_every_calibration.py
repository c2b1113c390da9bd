"""What calibration finds in simulated sessions of two watches and a camera, against what was planted there."""

import math
from collections.abc import Callable

import torch

from benchmarks.tables.calibration_session import MARKS, STANDING, SWINGS_S, CalibrationSession, simulate_calibration
from wearcap.geometry import rotation
from wearcap.metrics.table import Scores, Summary
from wearcap.sensors.camera_alignment import align_by_marks, mark_positions, mount_by_standing
from wearcap.sensors.clock import fit_swing_clock, swing_peaks
from wearcap.sensors.monocular_slam import _GravityScale, by_floor, by_head_imu
from wearcap.sensors.watch_calibration import measure_watches, require_watches

GOALS = {
    "watch_world_deg": 0.5,
    "watch_wrist_deg": 0.5,
    "slam_world_deg": 0.5,
    "head_camera_deg": 0.5,
    "scale_percent": 0.5,
    "clock_ms": 5.0,
}
"""Frames of the watches, their mounts, the SLAM's world, the camera's mount, its scale, the watches' clocks."""
EPOCH_S = 1.7e9
"""Watches count seconds since 1970; a timecode brings the clocks near each other first."""


def calibration_scores(sessions: int, step: Callable[[], None]) -> Scores:
    """Mean, worst and share within `GOALS` by seeds, camera at 60 and at 30 frames/s."""
    scores: Scores = {}
    for fps in (60.0, 30.0):
        errors: dict[str, list[float]] = {name: [] for name in GOALS}
        unaided: dict[str, dict[str, list[float]]] = {"by an IMU on the head": {}, "by the floor": {}}
        for seed in range(sessions):
            made = simulate_calibration(seed, camera_fps=fps)
            for name, found in _errors(made, fps).items():
                errors[name] += found
            ways = (
                by_head_imu(made.slam, made.head_imu),
                by_floor(made.slam, made.points_slam, STANDING, made.measured.standing_m),
            )
            for of, way in zip(unaided.values(), ways):
                for name, error in _scale_and_tilt(way, made).items():
                    of.setdefault(name, []).append(error)
            step()
        label = f"{fps:.0f} frames/s"
        scores |= _rows(label, errors)
        for way, found in unaided.items():
            scores |= _rows(f"{label}, no board, {way}", found)
    return scores


def _errors(made: CalibrationSession, fps: float) -> dict[str, list[float]]:
    watches = measure_watches(made.watches, made.board["left_wrist"], made.t_pose["left_wrist"])
    require_watches(made.watches, watches, made.t_pose["left_wrist"])
    marks, _, _ = mark_positions(made.slam, MARKS)
    aligned = align_by_marks(marks, made.measured.distances_m, made.measured.mark_height_m)
    mount = mount_by_standing(aligned.apply(made.slam), STANDING)
    middle = torch.tensor([SWINGS_S + 8], dtype=torch.float64)
    clocks = []
    for joint, stream in made.watches.items():
        clock = fit_swing_clock(made.swings_s, swing_peaks(stream) - EPOCH_S, 1 / fps)
        clocks.append((clock.clock.to_camera(middle - made.planted.offset_s[joint] - EPOCH_S) - middle).abs().item())
    return {
        "watch_world_deg": [
            _apart_deg(one.R_world_ref, made.planted.R_world_ref[joint]) for joint, one in watches.items()
        ],
        "watch_wrist_deg": [
            _apart_deg(one.R_joint_imu, made.planted.R_joint_imu[joint]) for joint, one in watches.items()
        ],
        "slam_world_deg": [_apart_deg(aligned.R_world_slam, made.planted.R_world_slam)],
        "head_camera_deg": [_apart_deg(mount.R_head_cam, made.planted.R_head_cam)],
        "scale_percent": [100 * abs(aligned.scale / made.planted.scale - 1)],
        "clock_ms": [1000 * error for error in clocks],
    }


def _scale_and_tilt(found: _GravityScale, made: CalibrationSession) -> dict[str, float]:
    cos = (found.R_world_slam[2] @ made.planted.R_world_slam[2]).clamp_max(1).item()
    return {
        "slam_world_deg": math.degrees(math.acos(cos)),
        "scale_percent": 100 * abs(found.scale / made.planted.scale - 1),
    }


def _apart_deg(a: torch.Tensor, b: torch.Tensor) -> float:
    return rotation.geodesic(a.double(), b.double()).rad2deg().item()


def _rows(label: str, errors: dict[str, list[float]]) -> Scores:
    def row(value: Callable[[str, list[float]], float]) -> dict[str, Summary]:
        return {name: Summary(value(name, found), None, 1) for name, found in errors.items()}

    return {
        f"{label}: mean": row(lambda _, found: sum(found) / len(found)),
        f"{label}: worst": row(lambda _, found: max(found)),
        f"{label}: within the goal (%)": row(
            lambda name, found: 100 * sum(error <= GOALS[name] for error in found) / len(found)
        ),
    }
