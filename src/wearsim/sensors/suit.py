"""A simulated inertial suit (Xsens-like): what it reports of a motion, and the sizes of its errors.

Sizes follow the literature on inertial capture: orientations of segments a few degrees off (calibration, drift, soft
tissue), a heading that drifts while walked distances are good (HPS thesis §5.3.1), and a body that the suit's maker
estimates from the wearer's height.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.stats
import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations, site_positions
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.errors import require_choice
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording.motion import Motion
from wearcap.sensors.simulated import heading_walk, smooth_noise

STRONG_ACC = 8.0
"""Acceleration (m/s²) at which soft tissue has moved its sensor by three quarters of the most that it can."""
MAGNETIC_WAVES = 64
"""Plane waves that make up the field of disturbances near steel."""


@dataclass(frozen=True)
class SegmentErrors:
    """Orientation errors of each segment: angles (°) as root mean squares over segments and axes."""

    fixed_deg: float = 2.5
    """Of the calibration, constant in a recording."""
    slow_deg: float = 2.5
    """Of the sensor fusion, varying over `slow_period_s`."""
    slow_period_s: float = 6.0
    soft_tissue_deg: float = 2.0
    """Largest error by the skin's movement under the limb's acceleration."""


@dataclass(frozen=True)
class PathErrors:
    """Errors of heading, walked distance and height of the root."""

    heading_walk_deg_per_sqrt_min: float = 2.2
    """Deviation of the heading's random walk after one minute."""
    heading_bias_deg_per_min: float = 0.1
    """Deviation of a rate of heading that is constant in a recording."""
    steel_deg: float = 1.0
    """Deviation of the magnetic heading from place to place, which the suit follows within `steel_s`."""
    steel_m: float = 3.0
    """Distance over which the disturbances change."""
    steel_s: float = 10.0
    scale: float = 0.003
    """Deviation of the scale of walked distances, constant in a recording."""
    step_scale: float = 0.004
    """Deviation of the scale of walked distances from step to step (over 2 s)."""
    height_m: float = 0.015
    """Deviation of the root's height error that is constant in a recording."""
    height_drift_m: float = 0.01
    """Deviation of the root's height error that varies over 20 s."""


@dataclass(frozen=True)
class BodyErrors:
    """Errors of the suit's model of the wearer's body."""

    bones: float = 0.03
    """Deviation of each segment's length, alike on both sides, as a share."""
    stature_m: float = 0.01
    """Deviation of the measured stature, to which the whole body is scaled."""


@dataclass(frozen=True)
class ContactErrors:
    """Errors of the reported foot contacts; values are drawn uniformly from the ranges once per recording."""

    delay_s: tuple[float, float] = (0.010, 0.040)
    wrong: tuple[float, float] = (0.02, 0.05)
    """Share of flags that are wrong besides being late, in bursts of a tenth of a second."""


@dataclass(frozen=True)
class SuitNoise:
    """Errors of a suit; the defaults are those of the preset "typical"."""

    segments: SegmentErrors = field(default_factory=SegmentErrors)
    path: PathErrors = field(default_factory=PathErrors)
    body: BodyErrors = field(default_factory=BodyErrors)
    contacts: ContactErrors = field(default_factory=ContactErrors)

    @classmethod
    def preset(cls, name: str) -> "SuitNoise":
        """Errors of a suit "ideal", "typical" or "poor". Raises WearcapError for another name."""
        require_choice(name, SUITS, f"suit={name!r}")
        return SUITS[name]


SUITS = {
    "ideal": SuitNoise(
        SegmentErrors(fixed_deg=1.0, slow_deg=1.0, soft_tissue_deg=0.5),
        PathErrors(
            heading_walk_deg_per_sqrt_min=0.3,
            heading_bias_deg_per_min=0.0,
            steel_deg=0.0,
            scale=0.001,
            step_scale=0.002,
            height_m=0.003,
            height_drift_m=0.003,
        ),
        BodyErrors(bones=0.0, stature_m=0.0),
        ContactErrors(delay_s=(0.005, 0.015), wrong=(0.0, 0.01)),
    ),
    "typical": SuitNoise(),
    "poor": SuitNoise(
        SegmentErrors(fixed_deg=3.5, slow_deg=3.0, soft_tissue_deg=3.0),
        PathErrors(
            heading_walk_deg_per_sqrt_min=4.0,
            heading_bias_deg_per_min=0.5,
            steel_deg=4.0,
            scale=0.005,
            step_scale=0.008,
            height_m=0.03,
            height_drift_m=0.02,
        ),
        BodyErrors(bones=0.04, stature_m=0.02),
        ContactErrors(delay_s=(0.020, 0.060), wrong=(0.04, 0.08)),
    ),
}
"""Suits by name."""


def suit_motion(
    motion: Motion, contact: Bool[Tensor, "time patch"], noise: SuitNoise, rng: np.random.Generator
) -> Motion:
    """The suit's estimate of `motion` on a body of its own, in a world that starts at the true one and drifts.

    `contact` is the ground truth of `FOOT_PATCHES`; the reported flags become a `contact_prob` of 0 or 1. The lowest
    foot of the suit's body is as high as the wearer's, but for the errors of height.
    """
    skeleton = estimated_skeleton(motion.skeleton, noise.body, rng)
    R_world_joint = _orientations(motion, noise.segments, rng)
    heading = _heading_error(motion, noise.path, rng)
    R_world_joint = heading[:, None] @ R_world_joint
    root = _path(motion, heading, noise.path, rng)
    R_parent_joint = local_rotations(skeleton, R_world_joint)
    if all(name in skeleton.sites for name in FOOT_PATCHES):
        T_world_joint = forward_kinematics(skeleton, R_parent_joint, root)
        root[:, 2] += _lowest_foot(motion.skeleton, motion.T_world_joint) - _lowest_foot(skeleton, T_world_joint)
    wander = smooth_noise(rng, len(motion), 1, 20.0, motion.fps)[:, 0]
    root[:, 2] += noise.path.height_m * float(rng.standard_normal()) + noise.path.height_drift_m * wander
    return replace(
        motion,
        skeleton=skeleton,
        R_parent_joint=R_parent_joint,
        t_world_root=root,
        contact_prob=_reported_contact(contact, noise.contacts, rng, motion.fps).float(),
        object_motion=None,
        provenance={"source": "simulated suit"},
    )


def estimated_skeleton(skeleton: Skeleton, errors: BodyErrors, rng: np.random.Generator) -> Skeleton:
    """The wearer's body as the suit's maker estimates it: bones of the wrong length that add up to a measured stature."""
    drawn: dict[str, float] = {}
    offsets = skeleton.t_parent_joint.clone()
    for joint, name in enumerate(skeleton.joint_names):
        part = name.removeprefix("left_").removeprefix("right_")
        if part not in drawn:
            drawn[part] = 1 + errors.bones * float(rng.standard_normal())
        offsets[joint] *= drawn[part] if joint else 1.0
    estimated = skeleton.with_offsets(offsets)
    measured = skeleton.stature + errors.stature_m * float(rng.standard_normal())
    return estimated.scaled(measured / estimated.stature)


def _orientations(motion: Motion, errors: SegmentErrors, rng: np.random.Generator) -> Float[Tensor, "time joint 3 3"]:
    """World orientations of the segments with errors of calibration, fusion and soft tissue, before the heading's."""
    length, joints, fps = len(motion), len(motion.skeleton), motion.fps
    fixed = torch.from_numpy(rng.standard_normal((1, joints, 3))).float()
    slow = smooth_noise(rng, length, joints * 3, errors.slow_period_s, fps)
    slow = rearrange(slow, "time (joint xyz) -> time joint xyz", xyz=3)
    T_world_joint = motion.T_world_joint
    sideways, axis = torch.nn.functional.normalize(
        torch.from_numpy(rng.standard_normal((2, joints, 3))).float(), dim=-1
    )
    position = scipy.ndimage.gaussian_filter1d(T_world_joint.t.double().numpy(), 0.03 * fps, axis=0, mode="nearest")
    acc_world = torch.from_numpy(np.gradient(np.gradient(position, axis=0), axis=0) * fps**2).float()
    acc_joint = (T_world_joint.R.mT @ acc_world[..., None])[..., 0]
    moved = torch.tanh((acc_joint * sideways).sum(-1, keepdim=True) / STRONG_ACC) * axis
    error = (errors.fixed_deg * fixed + errors.slow_deg * slow) / np.sqrt(3) + errors.soft_tissue_deg * moved
    return T_world_joint.R @ rotation.exp(torch.deg2rad(error))


def _heading_error(motion: Motion, errors: PathErrors, rng: np.random.Generator) -> Float[Tensor, "time 3 3"]:
    """Rotations about z by which the suit's heading is off: random walk, constant rate, and disturbances near steel."""
    length, fps = len(motion), motion.fps
    walked = heading_walk(rng, length, errors.heading_walk_deg_per_sqrt_min, fps)
    rate = errors.heading_bias_deg_per_min * float(rng.standard_normal())
    # A smooth random field over the floor: sum of plane waves with normally distributed wave vectors.
    wave = rng.standard_normal((MAGNETIC_WAVES, 2)) / errors.steel_m
    phase = rng.uniform(0.0, 2 * np.pi, MAGNETIC_WAVES)
    place = motion.t_world_root[:, :2].double().numpy()
    steel = np.sqrt(2 / MAGNETIC_WAVES) * np.cos(place @ wave.T + phase).sum(1)
    keep = np.exp(-1 / (errors.steel_s * fps))
    followed = np.asarray(scipy.signal.lfilter([1 - keep], [1, -keep], steel - steel[0]))
    angle = errors.steel_deg * followed + rate * np.arange(length) / fps / 60
    return rotation.about_axis("z", torch.from_numpy(np.deg2rad(angle)).float()) @ walked


def _path(
    motion: Motion, heading: Float[Tensor, "time 3 3"], errors: PathErrors, rng: np.random.Generator
) -> Float[Tensor, "time 3"]:
    """Positions of the root: the true steps integrated with errors of heading and scale, at the true height."""
    stretch = 1 + errors.scale * float(rng.standard_normal())
    stretch = stretch + errors.step_scale * smooth_noise(rng, len(motion), 1, 2.0, motion.fps)
    root = motion.t_world_root
    step = root.diff(dim=0, prepend=root[:1]).double()
    path = root[0] + ((heading.double() @ step[..., None])[..., 0] * stretch).cumsum(0)
    return torch.cat([path[:, :2], root[:, 2:]], -1).float()


def _lowest_foot(skeleton: Skeleton, T_world_joint: Rigid) -> Float[Tensor, "time"]:
    """Height (m) of the lowest patch of both feet."""
    return site_positions(skeleton, T_world_joint, FOOT_PATCHES)[..., 2].amin(-1)


def _reported_contact(
    contact: Bool[Tensor, "time patch"], errors: ContactErrors, rng: np.random.Generator, fps: float
) -> Bool[Tensor, "time patch"]:
    """Contact flags late by a delay of the recording (to a frame), and some of them wrong."""
    length = len(contact)
    late = round(float(rng.uniform(*errors.delay_s)) * fps)
    wrong = scipy.stats.norm.isf(float(rng.uniform(*errors.wrong)))
    delayed = torch.cat([contact[:1].expand(min(late, length), -1), contact[: max(length - late, 0)]])
    return delayed ^ (smooth_noise(rng, *contact.shape, 0.2, fps) > wrong)
