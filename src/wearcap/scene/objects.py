"""Objects of an interactive environment: shape, initial pose and degrees of freedom (thesis §5.2)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid

FREEDOMS = ("plane", "axis", "hinge", "free")
CONTACT_CLASSES = ("sliding", "hinged")
"""Kinds of interaction that have a contact network each (thesis §5.3.2)."""


@dataclass(frozen=True)
class Freedom:
    """How an object moves from its initial pose. Raises WearcapError for a kind without what it needs.

    "plane": slides and turns on the floor; "axis": slides along a line; "hinge": turns about a vertical axis;
    "free": is carried. World axes.
    """

    kind: str
    pivot: tuple[float, float, float] | None = None
    """A point of the hinge's axis (m)."""
    axis: tuple[float, float, float] | None = None
    """Direction of sliding, a unit vector."""
    limits: tuple[float, float] | None = None
    """Least and greatest angle (rad, counter-clockwise from above) or displacement along the axis (m); initially 0."""

    def __post_init__(self):
        if self.kind not in FREEDOMS:
            raise WearcapError(f"no degree of freedom {self.kind!r}", expected=f"one of {', '.join(FREEDOMS)}")
        if (self.kind == "hinge") != (self.pivot is not None):
            raise WearcapError(
                f"a {self.kind} {'with' if self.pivot else 'without'} a pivot",
                expected="a hinge and a point of its axis together",
            )
        if (self.kind == "axis") != (self.axis is not None):
            raise WearcapError(
                f"{self.kind!r} {'with' if self.axis else 'without'} an axis",
                expected="a slide along an axis and its direction together",
            )
        if self.axis is not None and abs(float(np.linalg.norm(self.axis)) - 1.0) > 1e-3:
            raise WearcapError(f"axis {self.axis}", expected="a unit vector")
        if self.limits is not None and not self.limits[0] <= 0.0 <= self.limits[1]:
            raise WearcapError(f"limits {self.limits}", expected="least ≤ 0 ≤ greatest: 0 is the initial pose")

    @property
    def contact_class(self) -> str:
        """Contact network responsible for the object: "hinged" or "sliding"."""
        return "hinged" if self.kind == "hinge" else "sliding"

    def clamped(self, value: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Angle or displacement, clamped to the limits."""
        return value if self.limits is None else value.clamp(*self.limits)

    def moved(self, T_world_object: Rigid, value: Float[Tensor, "*batch"]) -> Rigid:
        """Pose of an object with initial pose `T_world_object` at a hinge angle (rad) or axis displacement (m)."""
        if self.kind == "hinge":
            R = rotation.about_axis("z", value)
            pivot = torch.tensor(self.pivot, dtype=value.dtype)
            arm = T_world_object.t.to(value.dtype) - pivot
            return Rigid(R @ T_world_object.R.to(value.dtype), pivot + (R @ arm[..., None])[..., 0])
        if self.kind == "axis":
            shift = value[..., None] * torch.tensor(self.axis, dtype=value.dtype)
            R = T_world_object.R.to(value.dtype).expand(*value.shape, 3, 3)
            return Rigid(R, T_world_object.t.to(value.dtype) + shift)
        raise ValueError(f"{self.kind!r} has no single value")


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A movable object: a mesh (or a cloud: no faces) in its own axes, and its initial pose."""

    name: str
    category: str
    """"door", "window", "drawer", "sofa", "table", "chair", "box", …"""
    mesh: Mesh
    R_world_object: Float[Tensor, "3 3"]
    t_world_object: Float[Tensor, "3"]
    freedom: Freedom

    @property
    def T_world_object(self) -> Rigid:
        return Rigid(self.R_world_object, self.t_world_object)
