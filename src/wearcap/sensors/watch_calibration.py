"""Guided calibration of watches and a head camera: from the watches' reference frame to the world, and their mounting on
the wrist (MocapEvery C.2).

Both watches lie on a board whose axes are the world's (z up, y where the wearer will face), then are worn in a T-pose
that faces y. With our names eq. 6 and 7 read R_world_joint = R_world_ref R_ref_imu R_imu_joint,
acc_world = R_world_ref acc_ref, and R_imu_joint = R_world_imu(T)ᵀ R_world_joint(T). A skeleton's rest pose is a T-pose that
faces x, so that facing y R_world_joint(T) = Rz(90°) for both wrists. A constant error of the pose
cannot be distinguished from another mounting of the watch.

Times of steps count from `WatchSession.watch_zero` and `camera_zero`, so that they can be read off the logs. In the JSON
file rotations are unit quaternions (scalar first), with m, s, degrees, and the checks; what was not calibrated is absent:
{"watches": {"left_wrist": {"R_world_ref_wxyz", "R_joint_imu_wxyz", …}, …}, "clocks": {"left_wrist": {"camera_s", "watch_s", …}, …},
 "camera": {"scale", "R_world_slam_wxyz", "t_world_slam", …}, "head": {"R_head_cam_wxyz", "t_head_cam", …}, "checks": […]}
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json_object
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.geometry.light_roma import roma
from wearcap.geometry.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory, interpolate
from wearcap.recording.recording import FloorTrack, HeadStream, ImuStream, PointCloud, Recording
from wearcap.sensors.camera_alignment import HeadMount, SlamAlignment
from wearcap.sensors.clock import Clock, fit_swing_clock, swing_peaks
from wearcap.sensors.stillness import StepCheck, Stretch, during, require, still_intervals, unstillness_deg
from wearcap.sensors.watches import require_sides

FACING_DEG = 90.0
"""The T-pose faces the world's y."""


@dataclass(frozen=True)
class CalibrationLimits:
    """Limits of the quality checks of the board and the T-pose."""

    board_still_deg: float = 1.0
    board_tilt_deg: float = 3.0
    pose_still_deg: float = 4.0
    face_up_deg: float = 40.0
    """Angle between the vertical and the watch's face in the T-pose: palms down, watch on the back of the wrist."""
    arm_level_deg: float = 20.0
    arm_facing_deg: float = 25.0
    arms_apart_deg: float = 15.0
    """Angle between the lines of the two forearms."""


@dataclass(frozen=True)
class WatchCalibration:
    """Orientation of a watch's reference frame in the world and its mounting on the wrist, with quality measures."""

    joint: str
    R_world_ref: Float[Tensor, "3 3"]
    R_joint_imu: Float[Tensor, "3 3"]
    board_still_deg: float
    """Root mean square angle to the mean while on the board."""
    board_tilt_deg: float
    """Angle of the board's z to the vertical measured by the watch."""
    pose_still_deg: float

    @property
    def arm_facing_deg(self) -> float:
        """Horizontal angle of the forearm to the side direction of a wearer who faces the board's y."""
        x = self.R_joint_imu[:, 0]
        return math.degrees(math.atan2(abs(x[0].item()), abs(x[1].item())))

    def apply(self, stream: ImuStream) -> ImuStream:
        """The stream in the world: orientation and free acceleration (eq. 6), with the mounting on the wrist."""
        R_ref_imu = _orientation(stream)
        R = self.R_world_ref.to(R_ref_imu)
        acc = None if stream.acc_world is None else stream.acc_world @ R.mT
        return replace(
            stream, joint=self.joint, R_world_imu=R @ R_ref_imu, acc_world=acc, R_joint_imu=self.R_joint_imu.to(R)
        )


def measure_watches(streams: Mapping[str, ImuStream], board: Stretch, t_pose: Stretch) -> dict[str, WatchCalibration]:
    """Calibrate both watches (logs by joint, in their own reference frames, z up) without quality checks.

    Board and T-pose are stretches (s) on the watches' clocks. Raises WearcapError when a watch is missing, when the
    stretches overlap, and for a stretch that is shorter than 2 s or not in the log.
    """
    if missing := [joint for joint in WRISTS if joint not in streams]:
        raise WearcapError(f"no watch on {' and '.join(missing)}", expected=" and ".join(WRISTS))
    if board[0] < t_pose[1] and t_pose[0] < board[1]:
        what = f"board {board} and T-pose {t_pose} overlap"
        raise WearcapError(what, where="board and T-pose", expected="two stretches, one after the other")
    R_world_joint = rotation.about_axis("z", torch.tensor(math.radians(FACING_DEG), dtype=torch.float64))
    found = {}
    for joint in WRISTS:
        stream = streams[joint]
        R_ref_imu = _orientation(stream)
        on_board = R_ref_imu[during(stream.timestamps, board, f"board, {stream.joint}")]
        worn = R_ref_imu[during(stream.timestamps, t_pose, f"T-pose, {stream.joint}")]
        R_ref_world = rotation.mean_rotation(on_board.double())
        R_world_imu = R_ref_world.mT @ rotation.mean_rotation(worn.double())
        found[joint] = WatchCalibration(
            stream.joint,
            R_ref_world.mT.float().contiguous(),
            (R_world_joint.mT @ R_world_imu).float(),
            unstillness_deg(on_board),
            _angle_deg(R_ref_world[2, 2]),
            unstillness_deg(worn),
        )
    return found


def watch_checks(
    found: Mapping[str, WatchCalibration], limits: CalibrationLimits = CalibrationLimits()
) -> list[StepCheck]:
    """Quality checks of the board and the T-pose, in the order of the steps."""
    still = "Let go of the watches, and give a stretch in which nothing touches them."
    steady = "Hold the pose for 3 s without moving, or give a calmer stretch."
    flat = "Put the board on a level table, the watches' backs flat on it."
    palms = "Hold the palms down, the watch on the back of the wrist, its x axis along the forearm."
    level = "Raise both arms to the height of the shoulders."
    facing = "Face the board's y in the T-pose; on the board the 12 o'clock of both watches points along y."
    rows = []
    for joint, one in found.items():
        # In the T-pose the watch's x axis lies along the forearm, its face's z axis points up.
        slope_deg, face_up_deg = abs(90.0 - _angle_deg(one.R_joint_imu[2, 0])), _angle_deg(one.R_joint_imu[2, 2])
        for step, what, measured, limit, fix in (
            ("board", "not still", one.board_still_deg, limits.board_still_deg, still),
            ("board", "tilt of its z against gravity", one.board_tilt_deg, limits.board_tilt_deg, flat),
            ("T-pose", "not still", one.pose_still_deg, limits.pose_still_deg, steady),
            ("T-pose", "slope of the forearm", slope_deg, limits.arm_level_deg, level),
            ("T-pose", "face of the watch looks away from up", face_up_deg, limits.face_up_deg, palms),
            ("T-pose", "forearm away from the wearer's side", one.arm_facing_deg, limits.arm_facing_deg, facing),
        ):
            rows.append(StepCheck(f"{step}, {joint}", what, measured, limit, "°", fix))
    # The lines of the watches' x axes in the T-pose; crowns may point to the hand or to the elbow.
    left, right = (found[joint].R_joint_imu[:, 0] for joint in WRISTS)
    apart_deg, line = _angle_deg((left @ right).abs()), "the forearms' lines disagree"
    fix = "Stretch both arms out to one line; both watches lie on the board in the same direction."
    return [*rows, StepCheck("T-pose, both", line, apart_deg, limits.arms_apart_deg, "°", fix)]


def require_watches(
    streams: Mapping[str, ImuStream],
    found: Mapping[str, WatchCalibration],
    t_pose: Stretch,
    limits: CalibrationLimits = CalibrationLimits(),
) -> None:
    """Raise WearcapError for the first failed step, and for swapped logs.

    Left and right are checked when the arms hang, in the half minute after the T-pose.
    """
    require(watch_checks(found, limits))
    after = []
    for joint in WRISTS:
        stream = found[joint].apply(streams[joint])
        later = (stream.timestamps > t_pose[1]) & (stream.timestamps < t_pose[1] + 30)
        if not later.any():
            return
        R = stream.R_world_imu[later] @ stream.R_joint_imu.mT  # pyright: ignore[reportOptionalSubscript, reportOptionalMemberAccess]
        after.append(R[torch.linspace(0, len(R) - 1, 300).long()])
    require_sides(torch.stack(after, 1), "after the T-pose")


def propose_steps(streams: Mapping[str, ImuStream]) -> tuple[Stretch | None, Stretch | None]:
    """Propose the board and T-pose stretches (s) of two uncalibrated logs; None where not found.

    On the board both watches are level and stiller than any arm; in the later T-pose the faces still look up and the
    forearms are level.
    """
    still = [still_intervals(stream.timestamps, _orientation(stream)) for stream in streams.values()]
    board, t_pose = None, None
    overlaps = [(max(a[0], b[0]), min(a[1], b[1])) for a in still[0] for b in still[1]]
    for stretch in sorted(both for both in overlaps if both[1] - both[0] >= 2.0):
        parts = [_orientation(s)[during(s.timestamps, stretch, "")].double() for s in streams.values()]
        means = [rotation.mean_rotation(R) for R in parts]
        tilt = max(_angle_deg(R[2, 2]) for R in means)
        slope = max(abs(90 - _angle_deg(R[2, 0])) for R in means)
        limits = CalibrationLimits()
        if board is None:
            calm = max(unstillness_deg(R) for R in parts)
            board = stretch if tilt < limits.board_tilt_deg and calm < limits.board_still_deg else None
        elif tilt < limits.face_up_deg and slope < limits.arm_level_deg:
            t_pose = stretch
            break
    return board, t_pose


def _orientation(stream: ImuStream) -> Float[Tensor, "time 3 3"]:
    if stream.R_world_imu is None:
        what = "a watch's log without orientation"
        fix = "Switch on device motion when you record."
        raise WearcapError(what, where=stream.joint, expected="one with attitude", fix=fix)
    return stream.R_world_imu


def _angle_deg(cos: Tensor) -> float:
    return math.degrees(math.acos(min(max(cos.item(), -1.0), 1.0)))


MARK_S, STAND_S = 1.5, 8.0
"""Least durations (s) for which the camera rests on a mark, and the wearer stands."""


@dataclass(frozen=True)
class WornCalibration:
    """Result of a guided calibration; what was not calibrated is None or absent."""

    watches: dict[str, WatchCalibration]
    clocks: dict[str, Clock] = field(default_factory=dict)
    """Clock relation of the camera and each watch."""
    camera: SlamAlignment | None = None
    head: HeadMount | None = None


@dataclass(frozen=True)
class WatchSession:
    """Logs of both watches, by wrist, and the camera's path by SLAM, if there is one."""

    watches: dict[str, ImuStream]
    slam: Trajectory | None = None

    @property
    def watch_zero(self) -> float:
        """Time (s) at which both watches' logs have begun."""
        return max(stream.timestamps[0].item() for stream in self.watches.values())

    @property
    def camera_zero(self) -> float:
        """Time (s) of the first camera pose."""
        return 0.0 if self.slam is None else self.slam.timestamps[0].item()

    def proposed(self) -> dict[str, list[Stretch]]:
        """Stretches (s, from the zeros) of "board", "tpose", "marks" and "standing" that the logs probably contain."""
        found = {}
        for key, stretch in zip(("board", "tpose"), propose_steps(self.watches)):
            if stretch is not None:
                found[key] = [(stretch[0] - self.watch_zero, stretch[1] - self.watch_zero)]
        if self.slam is not None:
            still = still_intervals(self.slam.timestamps, self.slam.R_world_body, MARK_S, still_deg=1.0)
            steady = still_intervals(self.slam.timestamps, self.slam.R_world_body, STAND_S)
            zero = self.camera_zero
            if len(still) >= 4:
                found["marks"] = [(start - zero, stop - zero) for start, stop in still[:4]]
                steady = [stretch for stretch in steady if stretch[0] > still[3][1]]
            if steady:
                found["standing"] = [(steady[0][0] - zero, steady[0][1] - zero)]
        return found

    def swing_clock(
        self, watch: ImuStream, seen_s: Float64[Tensor, "swing"], stretch: Stretch, camera_fps: float
    ) -> Clock:
        """Clock relation of the camera and one calibrated watch, from times (s) at which the camera saw the swings.

        `stretch` is the part (s) of the watch's log with the swings. Raises WearcapError as `fit_swing_clock` does.
        """
        peaks = swing_peaks(watch, stretch) - self.watch_zero
        clock = fit_swing_clock(seen_s, peaks, 1 / camera_fps)
        return replace(clock, camera_s=clock.camera_s + self.camera_zero, suit_s=clock.suit_s + self.watch_zero)

    def added_to(
        self, recording: Recording, found: WornCalibration, points_slam: Float[Tensor, "point 3"] | None = None
    ) -> Recording:
        """The recording with the calibrated streams; z = 0 of its world is the floor the wearer stands on: MocapEvery's h_0.

        Points of the camera's SLAM, else those that the recording has beside a head stream, come into the same world.
        Raises WearcapError for a recording whose head stream is not that of the camera.
        """
        imu = {joint: found.watches[joint].apply(stream) for joint, stream in self.watches.items()}
        for joint, clock in found.clocks.items():
            imu[joint] = replace(imu[joint], timestamps=clock.to_camera(self.watches[joint].timestamps))
        recording = replace(recording, imu=recording.imu | imu)
        if self.slam is None or found.camera is None or found.head is None:
            return recording
        head = found.head.apply(found.camera.apply(self.slam))
        points = recording.points
        if points_slam is not None:
            points = PointCloud(found.camera.points(points_slam))
        elif points is not None and recording.head is not None:
            points = replace(points, points_world=_moved_along(points.points_world, recording.head, head))
        floor = recording.floor or FloorTrack(head.timestamps[:1], torch.zeros(1))
        return replace(recording, head=head, points=points, floor=floor)


_WATCH = ("R_world_ref", "R_joint_imu", "board_still_deg", "board_tilt_deg", "pose_still_deg")
_SAME_PATH_M = 0.05


def _moved_along(points: Float[Tensor, "point 3"], before: HeadStream, after: HeadStream) -> Float[Tensor, "point 3"]:
    """Points of the world of one head stream in that of another of the same head: by the similarity of the two paths."""
    start, stop = (
        pick(a, b)
        for pick, a, b in (
            (max, before.timestamps[0], after.timestamps[0]),
            (min, before.timestamps[-1], after.timestamps[-1]),
        )
    )
    at = after.timestamps[(after.timestamps >= start) & (after.timestamps <= stop)]
    fix = "Give the camera's own points: points=CLOUD.ply."
    if len(at) < 10:
        what = "the recording's points cannot be brought into the calibrated world: its head stream is of another time"
        raise WearcapError(what, expected="the path that the camera has", fix=fix)
    x, y = (interpolate(head.timestamps, head.t_world_device.double(), at) for head in (before, after))
    similarity: Any = roma.rigid_points_registration(x, y, compute_scaling=True)
    R, t, scale = similarity
    off = (scale * x @ R.mT + t - y).square().sum(-1).mean().sqrt().item()
    if not off < _SAME_PATH_M:
        what = f"the recording's points cannot be brought into the calibrated world: its head's path is {off:.2f} m off"
        raise WearcapError(what, expected=f"at most {_SAME_PATH_M} m", fix=fix)
    return (scale * points.double() @ R.mT + t).to(points.dtype)


_QUALITY = ("residual_m", "scale_spread", "corner_deg", "scale_std", "gravity_std_deg")
_CAMERA = ("scale", *_QUALITY, "R_world_slam", "t_world_slam")


def write_watch_calibration(
    found: WornCalibration, path: str | Path, checks: Sequence[StepCheck] = (), about: dict[str, Any] | None = None
) -> None:
    """Write a calibration, its checks and its metadata (plain numbers, text, lists), atomically."""
    content: dict[str, Any] = {
        "watches": {joint: _row(one, _WATCH) for joint, one in found.watches.items()},
        "clocks": {
            joint: {
                "camera_s": one.camera_s.tolist(),
                "watch_s": one.suit_s.tolist(),
                "swings": one.claps,
                "drift_s_per_hour": one.drift_s_per_hour,
                "residual_s": one.residual_s,
                "std_s": one.std_s,
            }
            for joint, one in found.clocks.items()
        },
    }
    if found.camera is not None:
        content["camera"] = _row(found.camera, _CAMERA)
    if found.head is not None:
        content["head"] = _row(found.head, ("R_head_cam", "t_head_cam", "still_deg"))
    content["checks"] = [_row(check, ("step", "what", "measured", "expected", "ok")) for check in checks]
    write_text(path, json.dumps(content | ({"about": about} if about else {}), indent=1) + "\n")


def _row(one: object, names: Sequence[str]) -> dict[str, Any]:
    """Attributes by name; rotations as unit quaternions, scalar first, and other tensors as lists."""
    row = {}
    for name in names:
        value = getattr(one, name)
        if value is None:
            continue
        if name.startswith("R_"):
            name, value = f"{name}_wxyz", quat_wxyz_from_matrix(value.double())
        row[name] = value.tolist() if isinstance(value, Tensor) else value
    return row


def read_watch_calibration(path: str | Path) -> WornCalibration:
    """What `write_watch_calibration` wrote. Raises WearcapError for a file that is no calibration."""
    content = read_json_object(path)
    with understood("not a calibration of watches", path, "the file of wearcap calibrate steps=watches"):
        watches = {
            joint: WatchCalibration(
                joint, *_tensors(row, _WATCH[:2], torch.float32), *(float(row[k]) for k in _WATCH[2:])
            )
            for joint, row in content["watches"].items()
        }
        clocks = {joint: _clock(row) for joint, row in content.get("clocks", {}).items()}
        camera, head = content.get("camera"), content.get("head")
        if camera is not None:
            R, t = _tensors(camera, ("R_world_slam", "t_world_slam"), torch.float64)
            quality = {name: float(camera[name]) for name in _QUALITY if name in camera}
            camera = SlamAlignment(float(camera["scale"]), R, t, **quality)
            if not (0 < camera.scale < 1e6 and bool(t.isfinite().all())):
                raise ValueError("a scale or place of the camera that is no number")
        if head is not None:
            R, t = _tensors(head, ("R_head_cam", "t_head_cam"), torch.float32)
            head = HeadMount(R, t, float(head["still_deg"]))
        if set(watches) != set(WRISTS):
            raise ValueError(f"watches on {', '.join(watches) or 'nothing'}")
        return WornCalibration(watches, clocks, camera, head)


def _clock(row: dict[str, Any]) -> Clock:
    knots = [torch.tensor([float(value) for value in row[key]], dtype=torch.float64) for key in ("camera_s", "watch_s")]
    if not len(knots[0]) or len(knots[0]) != len(knots[1]) or not bool(torch.cat(knots).isfinite().all()):
        raise ValueError("a clock without knots")
    drift, residual, std = (float(row[name]) for name in ("drift_s_per_hour", "residual_s", "std_s"))
    return Clock(*knots, drift, residual, int(row["swings"]), std)


def _tensors(row: dict[str, Any], names: Sequence[str], dtype: torch.dtype) -> list[Tensor]:
    """Rotations of unit quaternions, scalar first, and vectors."""
    found = []
    for name in names:
        key, size = (f"{name}_wxyz", 4) if name.startswith("R_") else (name, 3)
        value = torch.tensor([float(number) for number in row[key]], dtype=torch.float64)
        if value.shape != (size,) or not value.isfinite().all() or (size == 4 and abs(value.norm() - 1) > 0.01):
            raise ValueError(f"{key} of {row[key]}"[:100])
        found.append((matrix_from_quat_wxyz(value) if size == 4 else value).to(dtype))
    return found
