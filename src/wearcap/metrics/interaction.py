"""Errors of moved objects and contacting hands (thesis Tables 5.1, 5.2). Inputs in metres, results in cm and
degrees."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import geodesic

PAUSE_S = 0.5
"""Longest pause (s) between interactions with one object that count as one handling: a change of hands."""


@dataclass(frozen=True)
class PoseError:
    """Error of an object's pose at one or several times."""

    distance_cm: Float[Tensor, "*batch"]
    """Distance between the object's captured and true centre."""
    angle_deg: Float[Tensor, "*batch"]
    """Angle between the captured and the true orientation."""


def object_error(T_found: Rigid, T_true: Rigid, center: Float[Tensor, "3"]) -> PoseError:
    """Error of an object's poses; `center` is its centre in its own axes (m)."""
    found, true = T_found.to(torch.float64), T_true.to(torch.float64)
    middles = [(T.R @ center.double()) + T.t for T in (found, true)]
    apart = (middles[0] - middles[1]).norm(dim=-1)
    return PoseError(100 * apart, geodesic(found.R, true.R).rad2deg())


@dataclass(frozen=True)
class Handling:
    """One handling of an object, and the errors of its capture."""

    object: str
    category: str
    start_s: float
    stop_s: float
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
    start_s: Float[Tensor, "interval"],
    stop_s: Float[Tensor, "interval"],
    objects: tuple[str, ...],
    pause_s: float = PAUSE_S,
) -> list[tuple[str, float, float]]:
    """(object, start, stop) of every handling: intervals of one object with pauses of at most `pause_s` (s)."""
    merged: list[tuple[str, float, float]] = []
    for name in sorted(set(objects)):
        rows = sorted((a, b) for a, b, o in zip(start_s.tolist(), stop_s.tolist(), objects) if o == name)
        for start, stop in rows:
            if merged and merged[-1][0] == name and start - merged[-1][2] <= pause_s:
                merged[-1] = (name, merged[-1][1], max(stop, merged[-1][2]))
            else:
                merged.append((name, start, stop))
    return sorted(merged, key=lambda row: row[1])
