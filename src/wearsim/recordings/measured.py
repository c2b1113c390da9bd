"""An environment as people measure it: objects and hinges are centimetres and degrees from where they are."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from wearcap.geometry import rotation
from wearcap.scene.objects import Environment, SceneObject


@dataclass(frozen=True)
class EnvironmentErrors:
    """Deviations of measured places: root mean squares of distances."""

    position_m: float = 0.02
    """Of an object along the floor."""
    height_m: float = 0.005
    angle_deg: float = 2.0
    """Of an object about the vertical."""
    hinge_m: float = 0.015
    """Of a hinge along the floor, against its object."""


def as_measured(environment: Environment, errors: EnvironmentErrors, rng: np.random.Generator) -> Environment:
    """The environment with each object's initial pose and hinge off by drawn errors; directions of sliding turn along."""
    return Environment(tuple(_measured(item, errors, rng) for item in environment.objects))


def _measured(item: SceneObject, errors: EnvironmentErrors, rng: np.random.Generator) -> SceneObject:
    middle = torch.from_numpy(item.box_world.mean(0))
    drawn = rng.standard_normal(6) / np.sqrt([2, 2, 1, 1, 2, 2])
    shift = torch.from_numpy(drawn[:3] * [errors.position_m, errors.position_m, errors.height_m])
    turn = rotation.about_axis("z", torch.tensor(np.deg2rad(errors.angle_deg) * drawn[3]))

    def moved(point: Float64[torch.Tensor, "3"]) -> Float64[torch.Tensor, "3"]:
        return middle + shift + turn @ (point - middle)

    freedom = item.freedom
    if freedom.pivot is not None:
        pivot = moved(torch.tensor(freedom.pivot, dtype=torch.float64))
        off = torch.tensor([*errors.hinge_m * drawn[4:], 0.0], dtype=torch.float64)
        freedom = replace(freedom, pivot=tuple((pivot + off).tolist()))
    if freedom.axis is not None:
        freedom = replace(freedom, axis=tuple((turn @ torch.tensor(freedom.axis, dtype=torch.float64)).tolist()))
    return replace(
        item,
        R_world_object=(turn @ item.R_world_object.double()).to(item.R_world_object),
        t_world_object=moved(item.t_world_object.double()).to(item.t_world_object),
        freedom=freedom,
    )
