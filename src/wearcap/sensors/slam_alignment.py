"""The metric world of a camera's SLAM without a board: from the floor, an inertial sensor on the head, or walked distances."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, linear_velocity
from wearcap.recording.recording import ImuStream
from wearcap.sensors.camera_alignment import SlamAlignment
from wearcap.sensors.monocular_slam import by_floor, by_head_imu, clean_track, scale_by_walks
from wearcap.sensors.stillness import Stretch, during

MOST_DROPPED = 0.25
"""Share of poses that may be outliers; more is no head's path."""


@dataclass(frozen=True)
class SceneEvidence:
    """What shows a SLAM's scale and vertical; times are on the camera's clock (s)."""

    points_slam: Float[Tensor, "point 3"] | None = None
    """The SLAM's own points, the floor's among them."""
    standing: Stretch | None = None
    camera_height_m: float | None = None
    """Height of the camera above the floor while standing, by tape measure."""
    head_imu: ImuStream | None = None
    T_cam_imu: Rigid | None = None
    walks: tuple[tuple[float, float, float], ...] = ()
    """(start s, stop s, metres) of straight walks."""
    scale: float | None = None
    """Metres per unit where it is known; 1 for a SLAM that measures metres."""
    up: Float[Tensor, "3 3"] | None = None
    """Rotation to a world with z up where the vertical is known."""

    def align(self, slam: Trajectory) -> SlamAlignment:
        """Similarity to a world with z up whose floor, where it is known, is z = 0 and whose heading stays the SLAM's.

        The vertical comes from the head's sensor, else the floor, else `up`; the scale from walks, else with the vertical.
        Raises WearcapError where scale or vertical stay unknown, and as the estimators do.
        """
        found, spread = None, None
        if self.head_imu is not None:
            found = by_head_imu(slam, self.head_imu, self.T_cam_imu)
        elif self.points_slam is not None and self.standing is not None and self.camera_height_m is not None:
            found = by_floor(slam, self.points_slam, self.standing, self.camera_height_m)
        R, scale = (self.up, self.scale) if found is None else (found.R_world_slam, found.scale)
        scale_std = found and found.scale_std
        if self.walks:
            scale, spread = scale_by_walks(slam, self.walks)
            scale_std = None
        if R is None or scale is None or not 0 < scale < 1e6:
            what = "the vertical" if R is None else "the unit of length"
            fix = "Give unit=METRES; or find it: wearcap prepare trajectory with head_imu=, walks=, or points= and standing=."
            raise WearcapError(f"{what} of the camera's SLAM stays unknown", fix=fix)
        R = R.double()
        placed = scale * slam.t_world_body.double() @ R.mT
        return SlamAlignment(
            scale,
            R,
            self._origin(slam, placed),
            scale_spread=spread,
            scale_std=scale_std,
            gravity_std_deg=found and found.gravity_std_deg,
        )

    def _origin(self, slam: Trajectory, placed: Tensor) -> Tensor:
        """Translation that puts the floor at z = 0, where its distance is known."""
        if self.camera_height_m is None:
            return torch.zeros(3, dtype=torch.float64)
        if self.standing is None:
            level = torch.quantile(placed[:, 2], 0.9)  # upright most of the time
        else:
            level = placed[during(slam.timestamps, self.standing, "standing", 1.0), 2].mean()
        return torch.tensor([0.0, 0.0, self.camera_height_m - level.item()], dtype=torch.float64)


def facing(alignment: SlamAlignment, slam: Trajectory, standing: Stretch, facing_deg: float) -> SlamAlignment:
    """The alignment turned about the vertical, so that the camera of a standing wearer looks in a direction of the world,
    the place below being the origin."""
    inside = during(slam.timestamps, standing, "standing", 1.0)
    moved = alignment.apply(slam[inside])
    view = moved.R_world_body[:, :, 2].double().mean(0)
    if view[:2].norm() < 0.2:
        what = "the camera looks up or down while the wearer stands"
        raise WearcapError(what, where="standing", expected="straight ahead", fix="Give a stretch of looking ahead.")
    angle = torch.tensor(math.radians(facing_deg), dtype=torch.float64) - torch.atan2(view[1], view[0])
    turn = rotation.about_axis("z", angle)
    at = turn @ moved.t_world_body.double().mean(0)
    t = turn @ alignment.t_world_slam - torch.stack([at[0], at[1], torch.zeros_like(at[0])])
    return replace(alignment, R_world_slam=turn @ alignment.R_world_slam, t_world_slam=t)


def align_cleaned(
    slam: Trajectory, align: Callable[[Trajectory], SlamAlignment], max_acceleration: float, max_burst_s: float
) -> tuple[SlamAlignment, Trajectory, str]:
    """(alignment, the SLAM's path without outliers, a sentence on them).

    Outliers are known in metres: a first alignment gives the unit, and is repeated without them. Raises WearcapError as
    `align` does, and where most poses would be outliers: the unit is another one, or the times are.
    """
    first = align(slam)
    clean, kept, jumps = clean_track(slam, max_acceleration / first.scale, max_burst_s)
    dropped = int((~kept).sum())
    if dropped > MOST_DROPPED * len(kept):
        speed = first.scale * linear_velocity(slam).norm(dim=-1).median().item()
        fix = "Say the unit of length and of times, such as unit=0.01 for centimetres, time_unit=ms."
        what = (
            f"{dropped} of {len(kept)} poses accelerate as no head does; half of them are faster than {speed:.3g} m/s"
        )
        raise WearcapError(what, expected="a head's path in metres and seconds", fix=fix)
    notes = [f"{dropped} outliers of {len(kept)} camera poses removed"] if dropped else []
    if len(jumps):
        notes.append(f"{len(jumps)} jumps of the SLAM to another place stay, the first at {jumps[0].item():.2f} s")
    return (align(clean) if dropped else first), clean, "; ".join(notes)


def pose_of(values: Sequence[float] | None, name: str) -> Rigid | None:
    """A pose of 3 numbers (place, m) or 7 (place, unit quaternion with the scalar first); None for None.

    Raises WearcapError, naming the setting, for anything else.
    """
    if values is None:
        return None
    try:
        numbers = torch.tensor([float(value) for value in values])
    except (TypeError, ValueError) as error:
        raise WearcapError(f"{name}={values}", expected="[x,y,z] or [x,y,z,qw,qx,qy,qz]") from error
    if len(numbers) not in (3, 7) or (len(numbers) == 7 and abs(numbers[3:].norm() - 1) > 0.02):
        raise WearcapError(f"{name}={values}", expected="[x,y,z] or [x,y,z,qw,qx,qy,qz], a unit quaternion")
    R = torch.eye(3) if len(numbers) == 3 else rotation.matrix_from_quat_wxyz(numbers[3:])
    return Rigid(R, numbers[:3])
