"""Physical plausibility of a motion: jitter, foot skate, foot contact, floor penetration.

World z is up. Accelerations and third differences are computed in float64: they amplify rounding by fps² and fps³.
"""

import torch
from einops import rearrange, reduce
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool1d

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FEET, FOOT_PATCHES, SIDES, Skeleton
from wearcap.geometry.rigid import Rigid

FLOOR_WINDOW_S = 10.0
"""Time to either side of a frame in which the lowest true joint is the local floor (thesis §6.4: 20 s in total)."""
CONTACT_HEIGHT_M = 0.05
CONTACT_SPEED_M_S = 0.3
"""Speed below which EDGE takes a foot joint to be in contact: 0.01 m per frame at 30 Hz."""


def jitter_m_s3(joints: Float[Tensor, "time joint 3"], fps: float) -> Float[Tensor, ""]:
    """Jitter (m/s³): mean over joints and frames of the length of the third difference of position times fps³; NaN for
    fewer than four frames."""
    return joints.double().diff(n=3, dim=0).norm(dim=-1).mean() * fps**3


def foot_points(skeleton: Skeleton, T_world_joint: Rigid) -> Float[Tensor, "time foot point 3"]:
    """Two points (m) per foot, left foot first: heel and toe tip, or ankle and toe of a skeleton without such sites."""
    if all(patch in skeleton.sites for patch in FOOT_PATCHES):
        points = site_positions(skeleton, T_world_joint, FOOT_PATCHES)
        return rearrange(points, "time (foot point) xyz -> time foot point xyz", foot=FEET)
    return foot_joints(skeleton, T_world_joint)


def foot_joints(skeleton: Skeleton, T_world_joint: Rigid) -> Float[Tensor, "time foot point 3"]:
    """Ankle and toe joint (m) of both feet, left foot first."""
    joints = [skeleton.index(f"{side}_{name}") for side in SIDES for name in ("ankle", "toe")]
    return rearrange(T_world_joint.t[:, joints], "time (foot point) xyz -> time foot point xyz", foot=FEET)


def foot_contact(contact: Bool[Tensor, "time patch"]) -> Bool[Tensor, "time foot"]:
    """Whether heel or toe tip of each foot is in contact; patches in the order of `FOOT_PATCHES`."""
    return reduce(contact, "time (foot patch) -> time foot", "any", foot=FEET)


def contact_from_motion(
    points: Float[Tensor, "time foot point 3"], floor: Float[Tensor, "time"], fps: float
) -> Bool[Tensor, "time foot"]:
    """Contact from height and speed, where none was recorded: a point of the foot is less than 5 cm above the
    local floor and moves slower than 0.3 m/s (EDGE's 0.01 m per frame at 30 Hz)."""
    speed = points.diff(dim=0, prepend=points[:1]).norm(dim=-1) * fps
    low = points[..., 2] - floor[:, None, None] < CONTACT_HEIGHT_M
    return (low & (speed < CONTACT_SPEED_M_S)).any(-1)


def foot_skate_cm_s(
    points: Float[Tensor, "time foot point 3"], contact: Bool[Tensor, "time foot"], fps: float
) -> Float[Tensor, ""]:
    """Foot skate (cm/s): mean horizontal speed of a foot's lowest point (in the later frame of a pair) where both
    frames of the pair are in true contact; NaN without contact."""
    lowest = points[1:, :, :, 2].argmin(-1)[..., None]
    speed = points[..., :2].diff(dim=0).norm(dim=-1).gather(-1, lowest)[..., 0] * (fps * 100.0)
    return speed[contact[1:] & contact[:-1]].mean()


def physicality(
    t_world_root: Float[Tensor, "time 3"], feet: Float[Tensor, "time foot point 3"], fps: float
) -> Float[Tensor, ""]:
    """EDGE's physical foot contact score (m²/s²): mean over frames of ‖root acceleration‖ (its downward part
    clipped to 0) × ‖left foot velocity‖ × ‖right foot velocity‖, over the sequence's largest acceleration.

    A foot's velocity is that of the slower of its ankle and toe. An accelerating body must push on a standing foot, so
    lower is more plausible; report the ground truth's value for comparison. EDGE's code uses the feet's horizontal
    speed only (its paper, and this function, the full speed) and multiplies displacements per frame at 30 Hz by 10⁴,
    which makes its figures for level steps 11.1 times larger. NaN for fewer than three frames, 0 for a root that never
    accelerates.
    """
    acceleration = t_world_root.double().diff(n=2, dim=0) * fps**2
    acceleration = torch.cat([acceleration[:, :2], acceleration[:, 2:].clamp(min=0)], -1).norm(dim=-1)
    speed = (feet.double()[2:] - feet.double()[1:-1]).norm(dim=-1).amin(-1) * fps
    if len(acceleration) == 0:
        return torch.tensor(torch.nan, dtype=torch.float64)
    largest = acceleration.max().clamp(min=torch.finfo(torch.float64).tiny)
    return (acceleration * speed.prod(-1)).mean() / largest


def local_floor(
    joints_true: Float[Tensor, "time joint 3"], fps: float, window_s: float = FLOOR_WINDOW_S
) -> Float[Tensor, "time"]:
    """Height (m) of the lowest true joint within ±`window_s` of each frame, a floor estimate that follows stairs."""
    radius = round(window_s * fps)
    lowest = joints_true[..., 2].amin(-1)
    return -max_pool1d(-lowest[None, None], 2 * radius + 1, stride=1, padding=radius)[0, 0]


def floor_penetration_cm(joints: Float[Tensor, "time joint 3"], floor: Float[Tensor, "time"]) -> Float[Tensor, ""]:
    """Mean over frames of the depth (cm) of the lowest joint below the local floor, 0 where it is above."""
    return floor_depth_cm(joints, floor).mean()


def floor_depth_cm(joints: Float[Tensor, "time joint 3"], floor: Float[Tensor, "time"]) -> Float[Tensor, "time"]:
    """Depth (cm) of the lowest joint below the local floor in every frame, 0 where it is above."""
    return (floor - joints[..., 2].amin(-1)).clamp(min=0) * 100.0


def plausibility(
    skeleton: Skeleton,
    T_world_joint: Rigid,
    contact: Bool[Tensor, "time foot"],
    floor: Float[Tensor, "time"],
    fps: float,
) -> dict[str, Tensor]:
    """Jitter, foot skate, physicality and floor penetration by name with unit, of a captured or of the true motion.

    contact: true contact of each foot; floor: height (m) of the floor below the wearer.
    """
    joints = T_world_joint.t
    return {
        "jitter_m_s3": jitter_m_s3(joints, fps),
        "foot_skate_cm_s": foot_skate_cm_s(foot_points(skeleton, T_world_joint), contact, fps),
        "physicality": physicality(joints[:, 0], foot_joints(skeleton, T_world_joint), fps),
        "floor_penetration_cm": floor_penetration_cm(joints, floor),
    }
