"""An environment as people measure it: objects and hinges are centimetres and degrees from where they are."""

from dataclasses import dataclass, replace

import numpy as np
import torch

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
    measured = item.displaced(turn, middle, middle + shift)
    if measured.freedom.pivot is None:
        return measured
    pivot = np.array(measured.freedom.pivot) + np.array([*errors.hinge_m * drawn[4:], 0.0])
    return replace(measured, freedom=replace(measured.freedom, pivot=tuple(pivot.tolist())))
