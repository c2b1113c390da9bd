"""A calibration of watches and head camera as JSON: rotations as unit quaternions (scalar first), m, s, degrees, and the checks.

{"watches": {"left_wrist": {"R_world_ref_wxyz", "R_joint_imu_wxyz", …}, …}, "clocks": {"left_wrist": {"camera_s", "watch_s", …}, …},
 "camera": {"scale", "R_world_slam_wxyz", "t_world_slam", …}, "head": {"R_head_cam_wxyz", "t_head_cam", …}, "checks": […]};
what was not calibrated is absent.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from wearcap.files import write_text
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.sensors.stillness import StepCheck
from wearcap.sensors.watch_session import WornCalibration

_WATCH = ("board_still_deg", "board_tilt_deg", "pose_still_deg")
_CAMERA = ("scale", "residual_m", "scale_spread", "corner_deg")


def write_watch_calibration(
    found: WornCalibration, path: str | Path, checks: Sequence[StepCheck] = (), about: dict[str, Any] | None = None
) -> None:
    """Write a calibration, its checks and its metadata (plain numbers, text, lists), atomically."""
    content: dict[str, Any] = {
        "watches": {
            joint: {"R_world_ref_wxyz": _wxyz(one.R_world_ref), "R_joint_imu_wxyz": _wxyz(one.R_joint_imu)}
            | {name: getattr(one, name) for name in _WATCH}
            for joint, one in found.watches.items()
        },
        "clocks": {
            joint: {
                "camera_s": one.clock.camera_s.tolist(),
                "watch_s": one.clock.suit_s.tolist(),
                "swings": one.clock.claps,
                "drift_s_per_hour": one.clock.drift_s_per_hour,
                "residual_s": one.clock.residual_s,
                "std_s": one.std_s,
            }
            for joint, one in found.clocks.items()
        },
    }
    if found.camera is not None:
        content["camera"] = {name: getattr(found.camera, name) for name in _CAMERA} | {
            "R_world_slam_wxyz": _wxyz(found.camera.R_world_slam),
            "t_world_slam": found.camera.t_world_slam.tolist(),
        }
    if found.head is not None:
        content["head"] = {
            "R_head_cam_wxyz": _wxyz(found.head.R_head_cam),
            "t_head_cam": found.head.t_head_cam.tolist(),
            "still_deg": found.head.still_deg,
        }
    content["checks"] = [
        {"step": c.step, "what": c.what, "measured": c.measured, "expected": c.expected, "ok": c.ok} for c in checks
    ]
    write_text(path, json.dumps(content | ({"about": about} if about else {}), indent=1) + "\n")


def _wxyz(R: Tensor) -> list[float]:
    return quat_wxyz_from_matrix(R.double()).tolist()
