"""Simulated people, typical adults: bones, habits, and the device's place on the head."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Site, Skeleton, xsens23
from wearcap.simulation.people.style import Style

_LEG = ("hip", "knee", "ankle", "toe")
_ARM = ("collar", "shoulder", "elbow", "wrist")


@dataclass(frozen=True)
class Person:
    """One simulated wearer."""

    name: str
    skeleton: Skeleton
    style: Style
    shape: dict[str, float]
    """Body shape: height (m) and weight (kg)."""
    t_head_device: Float[Tensor, "3"]


def draw_person(name: str, rng: np.random.Generator) -> Person:
    """A person of 1.50–1.95 m with legs, arms and shoulders of their own proportions."""
    height = float(np.clip(rng.normal(1.72, 0.10), 1.50, 1.95))
    base = xsens23()
    stature = base.rest_sites["crown"][2].item() + base.root_height
    legs, arms, width = (float(np.clip(rng.normal(1.0, s), 1 - 2 * s, 1 + 2 * s)) for s in (0.03, 0.035, 0.05))
    scale = height / stature
    offsets = base.t_parent_joint * scale
    share = base.root_height / stature
    trunk = (1 - share * legs) / (1 - share)  # longer legs, shorter trunk: the height stays
    for joint, name_ in enumerate(base.joint_names):
        part = name_.removeprefix("left_").removeprefix("right_")
        if part in ("knee", "ankle"):
            offsets[joint] *= legs
        elif part in ("elbow", "wrist"):
            offsets[joint] *= arms
        elif part in ("hip", "collar", "shoulder"):
            offsets[joint, 1] *= width
            offsets[joint, 2] *= trunk
        elif part not in _LEG and part not in _ARM:
            offsets[joint, 2] *= trunk
    sites = {
        key: Site(site.joint, tuple(float(v) * scale for v in site.t_joint_site)) for key, site in base.sites.items()
    }
    skeleton = Skeleton(base.name, base.joint_names, base.parents, offsets, sites)
    mass_index = float(np.clip(rng.normal(24.0, 3.0), 18.0, 34.0))
    device = torch.tensor([rng.uniform(0.08, 0.10), rng.normal(0.0, 0.003), rng.uniform(0.08, 0.10)]).float()
    return Person(
        name,
        skeleton,
        Style.sample(rng, skeleton.root_height),
        {"height": height, "weight": mass_index * height**2},
        device,
    )
