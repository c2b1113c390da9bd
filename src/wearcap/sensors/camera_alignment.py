"""Alignment of a monocular SLAM's world by a board, and calibration of the head camera's mount (MocapEvery C.2).

The camera is put on four positions (`align_by_marks`): C1 and C2 on the board's y axis, C3 and C4 on its x axis, at
measured distances; the origin is where the axes meet. p_world = scale · R_world_slam p_slam + t_world_slam. Cameras are OpenCV's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.recording import HeadStream
from wearcap.sensors.stillness import StepCheck, Stretch, during, unstillness_deg

MARKS = ("C1", "C2", "C3", "C4")
T_HEAD_CAM_M = (0.09, 0.0, 0.09)
"""Nominal position of a camera on the forehead, relative to the head joint."""


@dataclass(frozen=True)
class AlignmentLimits:
    """Limits of the quality checks of the board positions and of standing."""

    residual_m: float = 0.01
    scale_spread: float = 0.03
    corner_deg: float = 3.0
    mark_still_m: float = 0.008
    mark_still_deg: float = 1.0
    stand_still_deg: float = 4.0
    view_deg: float = 60.0
    scale_std: float = 0.04
    gravity_std_deg: float = 2.0


@dataclass(frozen=True)
class SlamAlignment:
    """Similarity transform from a SLAM's world to the metric world, and how well what determined it fits.

    Of the board's four positions: residual, spread of scales and corner; of the floor or an inertial sensor: deviations.
    """

    scale: float
    """Metres per unit of the SLAM."""
    R_world_slam: Float64[Tensor, "3 3"]
    t_world_slam: Float64[Tensor, "3"]
    residual_m: float | None = None
    """Root mean square residual of the refinement: off-axis coordinates, heights, distances."""
    scale_spread: float | None = None
    """Relative difference between the scales from the measured distances."""
    corner_deg: float | None = None
    """Deviation of the two lines from a right angle."""
    scale_std: float | None = None
    """Relative standard deviation of the scale."""
    gravity_std_deg: float | None = None
    """Standard deviation of the vertical's direction."""

    def points(self, points_slam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Positions in the world (m)."""
        moved = self.scale * points_slam.double() @ self.R_world_slam.mT + self.t_world_slam
        return moved.to(points_slam.dtype)

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """Poses in the world."""
        R = self.R_world_slam.to(trajectory.R_world_body) @ trajectory.R_world_body
        return Trajectory(trajectory.timestamps, R, self.points(trajectory.t_world_body))

    def checks(
        self,
        moved_m: Float[Tensor, "mark"] | None = None,
        turned_deg: Sequence[float] = (),
        limits: AlignmentLimits = AlignmentLimits(),
    ) -> list[StepCheck]:
        """Quality checks; `moved_m` and `turned_deg` as from `mark_positions`, where the camera was on the board."""
        still = "Let go of the camera, or give a stretch in which it rests."
        ruler = "Measure |C1 C2| and |C3 C4| again, and check which position is which."
        rows = []
        for name, moved, turned in zip(MARKS, [] if moved_m is None else moved_m.tolist(), turned_deg):
            rows.append(StepCheck(f"camera on {name}", "moves", moved, limits.mark_still_m, "m", still))
            rows.append(StepCheck(f"camera on {name}", "turns", turned, limits.mark_still_deg, "°", still))
        axes = "Put C1 and C2 on the y axis, C3 and C4 on the x axis."
        more = "Walk with turns for half a minute, or look at more of the floor."
        step = "camera on the board" if self.corner_deg is not None else "camera's scale and vertical"
        for what, measured, factor, limit, unit, fix in (
            ("scales by the two distances differ", self.scale_spread, 100, limits.scale_spread, "%", ruler),
            ("axes miss a right angle", self.corner_deg, 1, limits.corner_deg, "°", axes),
            ("residual", self.residual_m, 1, limits.residual_m, "m", ruler),
            ("deviation of the scale", self.scale_std, 100, limits.scale_std, "%", more),
            ("deviation of the vertical", self.gravity_std_deg, 1, limits.gravity_std_deg, "°", more),
        ):
            if measured is not None:
                rows.append(StepCheck(step, what, factor * measured, factor * limit, unit, fix))
        return rows


@dataclass(frozen=True)
class HeadMount:
    """Mounting of a camera on the head."""

    R_head_cam: Float[Tensor, "3 3"]
    t_head_cam: Float[Tensor, "3"]
    still_deg: float
    """Root mean square angle to the mean while standing."""

    def apply(self, T_world_cam: Trajectory) -> HeadStream:
        """The camera's path as a head stream, with the device axes rotated to the head's."""
        R = T_world_cam.R_world_body
        return HeadStream(
            T_world_cam.timestamps,
            R @ self.R_head_cam.mT.to(R),
            T_world_cam.t_world_body,
            torch.eye(3),
            self.t_head_cam,
        )

    def checks(self, limits: AlignmentLimits = AlignmentLimits()) -> list[StepCheck]:
        """Quality checks of standing."""
        calm = "Stand upright and look ahead for 10 s, or give a calmer stretch."
        face = "Face the board's y while standing, or give the direction that you faced (facing_deg)."
        ahead = "optical axis away from straight ahead"
        view_deg = math.degrees(math.acos(min(max(self.R_head_cam[0, 2].item(), -1.0), 1.0)))
        return [
            StepCheck("standing", "not still", self.still_deg, limits.stand_still_deg, "°", calm),
            StepCheck("standing", ahead, view_deg, limits.view_deg, "°", face),
        ]


def mark_positions(
    slam: Trajectory, stretches: Sequence[Stretch]
) -> tuple[Float64[Tensor, "mark 3"], Float64[Tensor, "mark"], list[float]]:
    """Mean camera centres during the four stretches, the root mean square deviation of samples from them (SLAM units),
    and the camera's rotation meanwhile (degrees)."""
    if len(stretches) != len(MARKS):
        expected = "four: C1 and C2 on the y axis, C3 and C4 on the x axis"
        raise WearcapError(f"{len(stretches)} stretches on the board", where="camera on the board", expected=expected)
    inside = [during(slam.timestamps, s, f"camera on {name}", 1.0) for name, s in zip(MARKS, stretches)]
    there = [slam.t_world_body[part].double() for part in inside]
    mean = torch.stack([part.mean(0) for part in there])
    moved = torch.stack([(part - at).square().sum(-1).mean().sqrt() for part, at in zip(there, mean)])
    return mean, moved, [unstillness_deg(slam.R_world_body[part]) for part in inside]


def align_by_marks(
    marks_slam: Float[Tensor, "mark 3"], distances_m: tuple[float, float], height_m: float = 0.0
) -> SlamAlignment:
    """Similarity from the four positions, |C1 C2| and |C3 C4| (m), and the camera's height above the floor on the board.

    Closed form, then refined by least squares over all residuals at once. Raises WearcapError where two positions
    coincide, all lie on a line, or a distance is not positive.
    """
    C = marks_slam.double().numpy()
    lines = np.stack([C[1] - C[0], C[3] - C[2]])
    lengths = np.linalg.norm(lines, axis=1)
    if min(distances_m) <= 0 or not np.isfinite(C).all() or lengths.min() < 1e-9:
        what = f"distances of {distances_m} m, and {lengths.round(4).tolist()} in the SLAM"
        expected = "four different places and distances above 0"
        fix = "Measure |C1 C2| and |C3 C4| on the board."
        raise WearcapError(what, where="camera on the board", expected=expected, fix=fix)
    across = np.linalg.norm(np.cross(*lines)) / lengths.prod()
    if across < 0.5:
        what = f"C1 C2 and C3 C4 are {math.degrees(math.asin(across)):.0f}° apart"
        fix = "Put C1 and C2 on the y axis, C3 and C4 on the x axis."
        raise WearcapError(what, where="camera on the board", expected="90°", fix=fix)
    distances = np.array(distances_m)
    scales = distances / lengths
    # Closed form: scale by least squares, rotation by Procrustes, each coordinate of the origin a mean of what should be 0.
    normal = np.cross(lines[1], lines[0])
    there = np.stack([*(lines / lengths[:, None]), normal / np.linalg.norm(normal)])
    R = Rotation.align_vectors(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]), there)[0]
    scale = distances @ lengths / (lengths @ lengths)
    placed = scale * R.apply(C)
    t = -np.array([placed[:2, 0].mean(), placed[2:, 1].mean(), placed[:, 2].mean() - height_m])

    def residuals(x: np.ndarray) -> np.ndarray:
        """Residuals (m) of positions under a rotation vector, log scale and translation."""
        P = np.exp(x[3]) * Rotation.from_rotvec(x[:3]).apply(C) + x[4:]
        apart = [P[1, 1] - P[0, 1] - distances[0], P[3, 0] - P[2, 0] - distances[1]]
        return np.concatenate([P[:2, 0], P[2:, 1], P[:, 2] - height_m, apart])

    found = least_squares(residuals, np.concatenate([R.as_rotvec(), [np.log(scale)], t]), x_scale="jac")
    return SlamAlignment(
        float(np.exp(found.x[3])),
        torch.from_numpy(Rotation.from_rotvec(found.x[:3]).as_matrix()),
        torch.from_numpy(found.x[4:].copy()),
        float(np.sqrt(np.mean(found.fun**2))),
        float(abs(scales[0] - scales[1]) / scales.mean()),
        abs(90 - math.degrees(math.acos(np.clip(lines[0] @ lines[1] / lengths.prod(), -1, 1)))),
    )


def mount_by_standing(
    T_world_cam: Trajectory,
    standing: Stretch,
    facing_deg: float = 90.0,
    t_head_cam: tuple[float, float, float] = T_HEAD_CAM_M,
) -> HeadMount:
    """Mounting of the camera on the head of a wearer who stands upright and looks ahead in a given direction.

    R_head_cam = R_world_headᵀ mean(R_world_cam); the translation (m) is given.
    """
    R = T_world_cam.R_world_body[during(T_world_cam.timestamps, standing, "standing", 3.0)]
    R_world_head = rotation.about_axis("z", torch.tensor(math.radians(facing_deg), dtype=torch.float64))
    R_head_cam = R_world_head.mT @ rotation.mean_rotation(R.double())
    return HeadMount(R_head_cam.float(), torch.tensor(t_head_cam), unstillness_deg(R))
