"""Simulated people, typical adults: bones, habits of moving, and the device's place on the head."""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Site, Skeleton, xsens23


@dataclass(frozen=True)
class _Gait:
    """Habits of walking and standing (m, rad)."""

    speed: float
    """Preferred walking speed (m/s)."""
    walk_ratio: float
    """Step length per cadence (m per step/min); grows with the leg's length."""
    step_width: float
    stance_width: float
    toe_out: float
    variability: float
    """Deviation of step length, time and width from step to step, as a share."""
    knee_soft: float
    """Knee flexion at which the standing leg counts as straight."""
    heel_rise: float
    """Scales how far feet roll at push-off and landing."""


@dataclass(frozen=True)
class _Arms:
    """Habits of the hanging arms (rad)."""

    swing: float
    """Shoulder angle per metre between the feet (rad/m)."""
    symmetry: float
    """More swing left than right, as a share."""
    elbow: float
    abduction: float
    turn: float
    """Inward turn of the hanging arm: palms face back."""


@dataclass(frozen=True)
class _Posture:
    """Habits of trunk and head (rad)."""

    slouch: float
    """Forward lean of the chest."""
    head_pitch: float
    """Habitual downward tilt of the head while walking."""
    pelvis_tilt: float
    pelvis_yaw: float
    """Turn per metre between the feet (rad/m)."""
    pelvis_list: float
    trunk_counter: float
    """Trunk turn against the pelvis, as a share of the pelvis' turn."""
    sway: float
    """Standing sway (m)."""


@dataclass(frozen=True)
class _Style:
    """Habits that make one person's movement their own; `briskness` scales the tempo of all that is not walking."""

    gait: _Gait
    arms: _Arms
    posture: _Posture
    briskness: float


@dataclass(frozen=True)
class Person:
    """One simulated wearer."""

    name: str
    skeleton: Skeleton
    style: _Style
    shape: dict[str, float]
    """Body shape: height (m) and weight (kg)."""
    t_head_device: Float[Tensor, "3"]


LEG_M = 0.93
"""Height of the hips to which `speed` and `walk_ratio` of `NORMAL` belong."""
NORMAL = {
    "speed": (1.25, 0.13), "walk_ratio": (0.0065, 0.0005), "step_width": (0.10, 0.02), "stance_width": (0.19, 0.035),
    "toe_out": (0.12, 0.07), "symmetry": (0.0, 0.15), "slouch": (0.05, 0.05), "head_pitch": (0.12, 0.07),
}  # fmt: skip
"""Means and deviations of habits that are normally distributed among adults."""
LOGNORMAL = {
    "variability": 0.03, "knee_soft": 0.14, "heel_rise": 1.0, "swing": 0.46, "elbow": 0.30, "abduction": 0.14,
    "turn": 0.32, "pelvis_tilt": 0.07, "pelvis_yaw": 0.12, "pelvis_list": 0.06, "trunk_counter": 1.1, "sway": 0.005,
    "briskness": 1.0,
}  # fmt: skip
"""Medians of all others; their logarithms deviate by `LOG_DEVIATION`."""
LOG_DEVIATION = 0.22
LIMITS = {
    "heel_rise": (0.88, 1.12), "knee_soft": (0.08, 0.25), "step_width": (0.05, 0.16), "stance_width": (0.12, 0.30),
    "variability": (0.015, 0.05), "speed": (0.9, 1.65), "briskness": (0.7, 1.4),
}  # fmt: skip


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
    for joint, joint_name in enumerate(base.joint_names):
        part = joint_name.removeprefix("left_").removeprefix("right_")
        if part in ("knee", "ankle"):
            offsets[joint] *= legs
        elif part in ("elbow", "wrist"):
            offsets[joint] *= arms
        elif part in ("hip", "collar", "shoulder"):
            offsets[joint, 1] *= width
            offsets[joint, 2] *= trunk
        elif part != "toe":
            offsets[joint, 2] *= trunk
    sites = {
        key: Site(site.joint, tuple(float(v) * scale for v in site.t_joint_site)) for key, site in base.sites.items()
    }
    skeleton = Skeleton(base.name, base.joint_names, base.parents, offsets, sites)
    mass_index = float(np.clip(rng.normal(24.0, 3.0), 18.0, 34.0))
    device = torch.tensor([rng.uniform(0.08, 0.10), rng.normal(0.0, 0.003), rng.uniform(0.08, 0.10)]).float()
    shape = {"height": height, "weight": mass_index * height**2}
    drawn = {name: rng.normal(*spread) for name, spread in NORMAL.items()}
    drawn["speed"] *= (skeleton.root_height / LEG_M) ** 0.5
    drawn["walk_ratio"] = drawn["walk_ratio"] * skeleton.root_height / LEG_M
    drawn |= {name: median * float(np.exp(rng.normal(0.0, LOG_DEVIATION))) for name, median in LOGNORMAL.items()}
    drawn["heel_rise"] = rng.normal(1.0, 0.06)
    drawn |= {name: float(np.clip(drawn[name], *limits)) for name, limits in LIMITS.items()}
    habits = (part(**{f.name: drawn[f.name] for f in fields(part)}) for part in (_Gait, _Arms, _Posture))
    return Person(name, skeleton, _Style(*habits, drawn["briskness"]), shape, device)
