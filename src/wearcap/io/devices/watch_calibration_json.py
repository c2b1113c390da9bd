"""A calibration of watches and head camera as JSON: rotations as unit quaternions (scalar first), m, s, degrees, and the checks.

{"watches": {"left_wrist": {"R_world_ref_wxyz", "R_joint_imu_wxyz", …}, …}, "clocks": {"left_wrist": {"camera_s", "watch_s", …}, …},
 "camera": {"scale", "R_world_slam_wxyz", "t_world_slam", …}, "head": {"R_head_cam_wxyz", "t_head_cam", …}, "checks": […]};
what was not calibrated is absent.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.io.formats.text import read_json
from wearcap.sensors.arm_swings import SwingClock
from wearcap.sensors.camera_alignment import HeadMount, SlamAlignment
from wearcap.sensors.clock import Clock
from wearcap.sensors.stillness import StepCheck
from wearcap.sensors.watch_calibration import WatchCalibration

EXAMPLE = '{"watches": {"left_wrist": {"R_world_ref_wxyz": […], "R_joint_imu_wxyz": […], …}, "right_wrist": {…}}, …}'
_WATCH = ("board_still_deg", "board_tilt_deg", "pose_still_deg")
_CAMERA = ("scale", "residual_m", "scale_spread", "corner_deg")


@dataclass(frozen=True)
class WornCalibration:
    """Result of a guided calibration."""

    watches: dict[str, WatchCalibration]
    clocks: dict[str, SwingClock] = field(default_factory=dict)
    """Clock relation of the camera and each watch."""
    camera: SlamAlignment | None = None
    head: HeadMount | None = None


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


def read_watch_calibration(path: str | Path) -> WornCalibration:
    """Read what `write_watch_calibration` wrote. Raises WearcapError when it is missing, no JSON, or no calibration."""
    content = read_json(path)
    try:
        return WornCalibration(
            {joint: _watch(joint, row) for joint, row in content["watches"].items()},
            {joint: _clock(row) for joint, row in content.get("clocks", {}).items()},
            _camera(content["camera"]) if "camera" in content else None,
            _head(content["head"]) if "head" in content else None,
        )
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise WearcapError(
            f"not a watches' calibration ({what})"[:300],
            where=path,
            expected=EXAMPLE,
            fix="Calibrate again: wearcap calibrate steps=watches.",
        ) from error


def _watch(joint: str, row: Any) -> WatchCalibration:
    rotations = (_matrix(row[key]).float() for key in ("R_world_ref_wxyz", "R_joint_imu_wxyz"))
    return WatchCalibration(joint, *rotations, *(float(row[name]) for name in _WATCH))


def _clock(row: Any) -> SwingClock:
    camera_s, watch_s = (torch.tensor(row[key], dtype=torch.float64) for key in ("camera_s", "watch_s"))
    if camera_s.ndim != 1 or not len(camera_s) or camera_s.shape != watch_s.shape:
        raise ValueError("a clock without knots")
    clock = Clock(camera_s, watch_s, float(row["drift_s_per_hour"]), float(row["residual_s"]), int(row["swings"]))
    return SwingClock(clock, float(row["std_s"]))


def _camera(row: Any) -> SlamAlignment:
    quality = (float(row[name]) for name in _CAMERA[1:])
    return SlamAlignment(float(row["scale"]), _matrix(row["R_world_slam_wxyz"]), _three(row["t_world_slam"]), *quality)


def _head(row: Any) -> HeadMount:
    return HeadMount(
        _matrix(row["R_head_cam_wxyz"]).float(), _three(row["t_head_cam"]).float(), float(row["still_deg"])
    )


def _wxyz(R: Tensor) -> list[float]:
    return quat_wxyz_from_matrix(R.double()).tolist()


def _matrix(wxyz: Any) -> Tensor:
    quaternion = torch.tensor(wxyz, dtype=torch.float64)
    if quaternion.shape != (4,) or not abs(quaternion.norm().item() - 1) < 0.01:
        raise ValueError(f"{wxyz} is no unit quaternion")
    return matrix_from_quat_wxyz(quaternion)


def _three(value: Any) -> Tensor:
    vector = torch.tensor(value, dtype=torch.float64)
    if vector.shape != (3,) or not vector.isfinite().all():
        raise ValueError(f"{value} is no position")
    return vector
