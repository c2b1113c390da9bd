"""How well objects and the hands that move them were captured (thesis Tables 5.1, 5.2). Metres in, cm and degrees out."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import geodesic

PAUSE_S = 0.5
"""Interactions with one object that follow each other sooner are one handling: hands were changed."""


@dataclass(frozen=True)
class PoseError:
    """Of an object's pose at one time, or over several."""

    distance_cm: Float[Tensor, "*batch"]
    """Between the object's centres."""
    angle_deg: Float[Tensor, "*batch"]


def object_error(T_found: Rigid, T_true: Rigid, center: Float[Tensor, "3"]) -> PoseError:
    """Error of an object's poses; `center` is its middle in its own axes (m)."""
    found, true = T_found.to(torch.float64), T_true.to(torch.float64)
    middles = [(T.R @ center.double()) + T.t for T in (found, true)]
    apart = (middles[0] - middles[1]).norm(dim=-1)
    return PoseError(100 * apart, geodesic(found.R, true.R).rad2deg())


@dataclass(frozen=True)
class Handling:
    """One handling of an object and how it was captured."""

    object: str
    category: str
    start_s: float
    stop_s: float
    end_cm: float
    """Of the object's centre where it was left (Table 5.1)."""
    end_deg: float
    moved_cm: float
    """How far the truth's centre moved: the error of one who holds it static, were it right before."""
    hand_object_cm: float
    """From contacting palms to the captured object, mean over the true contact (Table 5.2)."""
    hand_cm: float
    """Of contacting palms from where they truly were."""
    object_cm: float
    """Of the object's centre from where it truly was, mean over the true contact."""
    object_deg: float


MEASURES = ("end_cm", "end_deg", "hand_object_cm", "hand_cm", "object_cm", "object_deg")


def summary(rows: Sequence[Handling]) -> dict[str, float]:
    """Mean of every measure over the handlings that have it; NaN without any."""
    values = torch.tensor([[getattr(row, name) for name in MEASURES] for row in rows], dtype=torch.float64)
    return dict(zip(MEASURES, values.reshape(-1, len(MEASURES)).nanmean(0).tolist()))


def contact_mean(value: Float[Tensor, "time hand"], contact: Bool[Tensor, "time hand"]) -> Float[Tensor, ""]:
    """Mean over the frames and hands that are in contact; NaN where none is."""
    return value[contact].mean() if bool(contact.any()) else value.new_tensor(float("nan"))


def handlings(
    start_s: Float[Tensor, "interval"], stop_s: Float[Tensor, "interval"], objects: tuple[str, ...],
    pause_s: float = PAUSE_S,
) -> list[tuple[str, float, float]]:  # fmt: skip
    """(object, start, stop) of every uninterrupted handling of an object: intervals that follow within `pause_s`."""
    merged: list[tuple[str, float, float]] = []
    for name in sorted(set(objects)):
        rows = sorted((a, b) for a, b, o in zip(start_s.tolist(), stop_s.tolist(), objects) if o == name)
        for start, stop in rows:
            if merged and merged[-1][0] == name and start - merged[-1][2] <= pause_s:
                merged[-1] = (name, merged[-1][1], max(stop, merged[-1][2]))
            else:
                merged.append((name, start, stop))
    return sorted(merged, key=lambda row: row[1])
