"""Errors of moved objects: ECHO's tables (eq. 14–17, §9), with joint velocity and foot contact, and iReplica's (thesis
Tables 5.1, 5.2), with contacting hands.

Inputs in metres; results in cm, mm and degrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import geodesic, quat_wxyz_from_matrix

ANKLE_M, TOE_M = 0.10, 0.05
"""Heights (m) above the floor below which an ankle and a toe joint are in contact (ECHO §9)."""


def vertex_error_cm(T_found: Rigid, T_true: Rigid, vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, "*batch"]:
    """E_v2v (eq. 16): mean position error (cm) of an object's vertices, which are given in its own axes."""
    turn, shift = T_found.R - T_true.R, T_found.t - T_true.t
    return 100 * (vertices @ turn.mT + shift[..., None, :]).norm(dim=-1).mean(-1)


def center_error_cm(T_found: Rigid, T_true: Rigid, vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, "*batch"]:
    """E_c (eq. 17): position error (cm) of the vertices' mean."""
    center = vertices.mean(0)
    return 100 * (T_found @ center - T_true @ center).norm(dim=-1)  # pyright: ignore[reportOperatorIssue]


def rotation_difference_deg(T_found: Rigid, T_true: Rigid) -> Float[Tensor, "*batch"]:
    """Angle (degrees) between the captured and the true orientation."""
    return geodesic(T_found.R, T_true.R).rad2deg()


def quaternion_difference(T_found: Rigid, T_true: Rigid) -> Float[Tensor, "*batch"]:
    """L1 distance of unit quaternions with non-negative scalar part (ECHO does not define the sign)."""
    found, true = (quat_wxyz_from_matrix(T.R) for T in (T_found, T_true))
    return (found - true).abs().sum(-1)


def joint_step_error_mm(
    joints: Float[Tensor, "time joint 3"], joints_true: Float[Tensor, "time joint 3"]
) -> Float[Tensor, ""]:
    """MPJVE (eq. 15): mean error of the joints' displacements from frame to frame, in mm per frame (at 30 Hz there).

    ECHO prints no unit. "Velocity at step i" is U^i = J^i − J^(i−1), not divided by time, and positions are in mm: mm per
    frame by its words. Its figures cannot be that, 66.8 beside an MPJPE of 61.4 would be 2 m/s; nor mm/s, where the best
    methods of three tracked points have 144 to 277. By its symbols i counts joints, as in eq. 14: U is then the offset
    from one joint to the next, whose error in mm is of MPJPE's size, as all of ECHO's figures are (1.07 to 1.38 times
    MPJPE). They are no yardstick for ours.
    """
    return 1000 * (joints - joints_true).diff(dim=0).norm(dim=-1).mean()


def foot_contact_share(
    skeleton: Skeleton, joints: Float[Tensor, "time joint 3"], floor_height: Float[Tensor, "time"]
) -> Float[Tensor, ""]:
    """FC: share of frames in which an ankle is less than 10 cm, or a toe joint less than 5 cm, above the floor."""
    low = []
    for name, limit in (("ankle", ANKLE_M), ("toe", TOE_M)):
        at = skeleton.indices(f"left_{name}", f"right_{name}")
        low.append(joints[:, at, 2] - floor_height[:, None] < limit)
    return torch.cat(low, 1).any(1).float().mean()


PAUSE_S = 0.5
"""Longest pause (s) between interactions with one object that count as one handling: a change of hands."""


def object_error(
    T_found: Rigid, T_true: Rigid, center: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Errors of an object's poses: distance (cm) of its centre, which is given in its own axes (m), and angle (degrees)."""
    found, true = T_found.to(torch.float64), T_true.to(torch.float64)
    middles = [(T.R @ center.double()) + T.t for T in (found, true)]
    return 100 * (middles[0] - middles[1]).norm(dim=-1), rotation_difference_deg(found, true)


@dataclass(frozen=True)
class Handling:
    """One handling of an object, and the errors of its capture."""

    object: str
    category: str
    span_s: tuple[float, float]
    """First and last time of its interactions."""
    end_cm: float
    """Position error of the object's centre after its release (Table 5.1)."""
    end_deg: float
    """Orientation error of the object after its release (Table 5.1)."""
    moved_cm: float
    """True displacement of the object's centre: the error of a static object that was right before."""
    hand_object_cm: float
    """Distance from contacting palms to the captured object, mean over the true contact (Table 5.2)."""
    hand_cm: float
    """Position error of contacting palms, mean over the true contact."""
    object_cm: float
    """Position error of the object's centre, mean over the handling."""
    object_deg: float
    """Orientation error of the object, mean over the handling."""


MEASURES = ("end_cm", "end_deg", "hand_object_cm", "hand_cm", "object_cm", "object_deg")


def summary(rows: Sequence[Handling]) -> dict[str, float]:
    """Mean of every measure over the handlings where it is defined; NaN if there are none."""
    values = torch.tensor([[getattr(row, name) for name in MEASURES] for row in rows], dtype=torch.float64)
    return dict(zip(MEASURES, values.reshape(-1, len(MEASURES)).nanmean(0).tolist()))


def contact_mean(value: Float[Tensor, "time hand"], contact: Bool[Tensor, "time hand"]) -> Float[Tensor, ""]:
    """Mean over the frames and hands in contact; NaN without contact."""
    return value[contact].mean() if bool(contact.any()) else value.new_tensor(float("nan"))


def handlings(
    start_s: Float[Tensor, "interval"], stop_s: Float[Tensor, "interval"], objects: tuple[str, ...]
) -> list[tuple[str, float, float]]:
    """(object, start, stop) of every handling: intervals of one object with pauses of at most `PAUSE_S`."""
    merged: list[tuple[str, float, float]] = []
    for name in sorted(set(objects)):
        rows = sorted((a, b) for a, b, o in zip(start_s.tolist(), stop_s.tolist(), objects) if o == name)
        for start, stop in rows:
            if merged and merged[-1][0] == name and start - merged[-1][2] <= PAUSE_S:
                merged[-1] = (name, merged[-1][1], max(stop, merged[-1][2]))
            else:
                merged.append((name, start, stop))
    return sorted(merged, key=lambda row: row[1])
