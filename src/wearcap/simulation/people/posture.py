"""The trunk over the feet: a pendulum's centre of mass, a pelvis that the legs can carry, a counter-turning chest."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.simulation.people.gait import FootMotion, load_on_left
from wearcap.simulation.people.plan import SIDES, Plan
from wearcap.simulation.people.track import blur, falling_at_most, lower_envelope, pendulum, wander

SPINE = ("l5", "l3", "t12", "t8")
GRAVITY = 9.81
ENVELOPE_S = 0.06
STEP_ENVELOPE_S, LEVELLED = 0.26, 0.12
"""Share by which the pelvis stays nearer in walking to the height that it can keep over a whole step."""
STAIR_APART_M, STAIRS_LEVELLED = 0.15, 0.5
"""On stairs (feet so far apart in height) knees bend more, which evens out the pelvis' path."""
BOUNCE_M, BOUNCE_MIDDLE = 0.12, 0.68
"""In running the pelvis is lowest over the bent standing leg and rises in flight: by how much, about which load."""
HIPS_AHEAD_M = 0.042
"""Additional forward offset of the hips in walking, relative to standing."""
STANCE_BEND = 0.9
"""More bend of a bearing knee in walking than in standing, as a share of the knee's softness."""


@dataclass(frozen=True)
class Trunk:
    """Pelvis and chest over time; angles are yaw, forward pitch and roll to the right in the world (rad)."""

    pelvis: Float[np.ndarray, "time 3"]
    pelvis_angles: Float[np.ndarray, "time 3"]
    chest_angles: Float[np.ndarray, "time 3"]
    heading: Float[np.ndarray, "time"]
    stride: Float[np.ndarray, "time"]
    """Left foot ahead of the right one (m), smooth."""
    speed: Float[np.ndarray, "time"]


def rotation_of(angles: Float[np.ndarray, "time 3"]) -> Float[Tensor, "time 3 3"]:
    """Matrix of yaw, pitch and roll: Rz Ry Rx."""
    yaw, pitch, roll = torch.from_numpy(np.ascontiguousarray(angles)).unbind(-1)
    about = rotation.about_axis
    return about("z", yaw) @ about("y", pitch) @ about("x", roll)


@dataclass(frozen=True)
class Stance:
    """Quantities that follow from the feet before the trunk is placed over them, with all random draws."""

    heading: Float[np.ndarray, "time"]
    load: Float[np.ndarray, "time"]
    """Share of the weight on the left foot."""
    mass: Float[np.ndarray, "time 2"]
    """Position of the centre of mass over the floor (m)."""
    speed: Float[np.ndarray, "time"]
    acceleration: Float[np.ndarray, "time 2"]
    stride: Float[np.ndarray, "time"]
    drift: Float[np.ndarray, "time 6"]

    @property
    def forward(self) -> Float[np.ndarray, "time 2"]:
        return np.stack([np.cos(self.heading), np.sin(self.heading)], 1)


HELP = ("lean", "bend", "twist", "crouch", "ahead", "aside")
"""Trunk motions that help hands to reach, columns of `help_`: as `Plan.lean` (rad), `crouch` and `shift` (m)."""


def stance_motion(
    plan: Plan, feet: dict[str, FootMotion], times: Float[np.ndarray, "time"], fps: float, rng: np.random.Generator
) -> Stance:
    """Motion of the wearer's mass over the feet."""
    left, right = (feet[side] for side in SIDES)
    count = len(times)
    heading = blur((left.heading + right.heading) / 2, 0.13, fps)
    forward = np.stack([np.cos(heading), np.sin(heading)], 1)
    load = load_on_left(np.stack([left.planted, right.planted], 1), times, rng)
    pressure = load[:, None] * left.pressure + (1 - load[:, None]) * right.pressure
    pressure = pressure[:, :2] + wander(rng, count, 2, 2.2, plan.style.sway, fps)
    rate = float(np.sqrt(GRAVITY / (1.06 * plan.hip_height)))
    mass = pendulum(pressure, rate, fps)
    velocity = np.gradient(mass, axis=0) * fps
    speed = blur((velocity * forward).sum(1), 0.3, fps)
    acceleration = blur(rate**2 * (mass - pressure), 0.1, fps)
    stride = blur(((left.ankle - right.ankle)[:, :2] * forward).sum(1), 0.06, fps)
    return Stance(heading, load, mass, speed, acceleration, stride, wander(rng, count, 6, 2.5, 0.010, fps))


def trunk_motion(
    plan: Plan,
    feet: dict[str, FootMotion],
    stance: Stance,
    times: Float[np.ndarray, "time"],
    fps: float,
    help_: Float[np.ndarray, "time 6"] | None = None,
) -> Trunk:
    """Pelvis and chest that follow from the feet, the plan's channels, the wearer's habits and the hands' need."""
    style, heading, forward, stride, drift = (plan.style, stance.heading, stance.forward, stance.stride, stance.drift)
    seated = plan.seat_weight.sample(times)
    moving = np.clip(np.abs(stance.speed) / 0.8, 0.0, 1.0)
    lean, crouch, shift = plan.lean.sample(times), plan.crouch.sample(times)[:, 0], plan.shift.sample(times)
    if help_ is not None:
        lean, crouch, shift = lean + help_[:, :3], crouch + help_[:, 3], shift + help_[:, 4:]

    pelvis_angles = np.stack(
        [
            heading - style.pelvis_yaw * stride * (1 - seated[:, 0]) + 0.3 * lean[:, 2],
            style.pelvis_tilt * (0.4 + 0.6 * moving) + 0.45 * lean[:, 0] + drift[:, 0],
            _list(style.pelvis_list, blur(stance.load, 0.05, fps), moving) + 0.15 * lean[:, 1],
        ],
        1,
    )
    across = np.stack([-forward[:, 1], forward[:, 0]], 1)
    sideways = (stance.acceleration * across).sum(1)
    chest_angles = np.stack(
        [
            heading + style.trunk_counter * style.pelvis_yaw * blur(stride, 0.05, fps) + lean[:, 2] + drift[:, 1],
            style.slouch
            + 0.035 * stance.speed
            + 0.03 * blur((stance.acceleration * forward).sum(1), 0.12, fps)
            + lean[:, 0]
            + drift[:, 2],
            -0.35 * pelvis_angles[:, 2] - 0.025 * sideways + lean[:, 1] + drift[:, 3],
        ],
        1,
    )
    back = 0.26 * plan.hip_height * np.sin(np.clip(lean[:, 0], -0.5, 1.5)) + 0.012 - HIPS_AHEAD_M * moving
    place = stance.mass - back[:, None] * forward
    place = place + shift[:, :1] * forward + shift[:, 1:] * across
    seat = plan.seat.sample(times)
    place += seated[:, :1] * (seat[:, :2] - place)
    height = _height(plan, feet, place, moving, rotation_of(pelvis_angles), fps) - crouch
    height += seated[:, 1] * (seat[:, 2] - height)
    pelvis = np.concatenate([place, height[:, None]], 1)
    return Trunk(pelvis, pelvis_angles, chest_angles, heading, stride, stance.speed)


@dataclass(frozen=True)
class Spine:
    """World rotations of the joints of `SPINE` in order, the last one the chest's, and where the chest is."""

    R_world: Float[Tensor, "time joint 3 3"]
    t_world_chest: Float[Tensor, "time 3"]

    @property
    def chest(self) -> Rigid:
        return Rigid(self.R_world[:, -1], self.t_world_chest)


def spine_motion(skeleton: Skeleton, trunk: Trunk) -> Spine:
    """The turn between pelvis and chest, shared evenly among the spine's joints."""
    R_pelvis, R_chest = rotation_of(trunk.pelvis_angles), rotation_of(trunk.chest_angles)
    between = rotation.log(R_pelvis.transpose(-1, -2) @ R_chest)
    position, rotations = torch.from_numpy(trunk.pelvis), [R_pelvis]
    for number, name in enumerate(SPINE, start=1):
        position = position + rotations[-1] @ skeleton.t_parent_joint[skeleton.index(name)].double()
        rotations.append(R_pelvis @ rotation.exp(number / len(SPINE) * between))
    return Spine(torch.stack(rotations[1:], 1), position)


def _list(amount: float, load: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """The pelvis drops on the side that swings: roll to the right while the left leg stands."""
    return amount * (0.35 + 0.65 * moving) * np.sin(np.pi * (load - 0.5))


def _height(
    plan: Plan,
    feet: dict[str, FootMotion],
    place: Float[np.ndarray, "time 2"],
    moving: Float[np.ndarray, "time"],
    R_world_pelvis: Float[Tensor, "time 3 3"],
    fps: float,
) -> Float[np.ndarray, "time"]:
    """Height of the pelvis (m): as high as both legs let it, with soft knees, and smooth."""
    skeleton = plan.skeleton
    limits = []
    for side in SIDES:
        hip, knee, ankle = (
            skeleton.t_parent_joint[skeleton.index(f"{side}_{joint}")].double() for joint in ("hip", "knee", "ankle")
        )
        bears = blur(feet[side].planted.astype(np.float64), 0.08, fps)
        soft = np.zeros_like(place[:, :1]).repeat(3, 1)
        soft[:, 1] = plan.style.knee_soft * (0.5 + (0.5 + STANCE_BEND * moving) * bears)
        lower = rotation.exp(torch.from_numpy(soft)) @ ankle[:, None]
        leg = (knee + lower[..., 0]).norm(dim=-1).numpy()
        offset = (R_world_pelvis @ hip).numpy()
        away = np.linalg.norm(feet[side].ankle[:, :2] - place - offset[:, :2], axis=1)
        up = np.sqrt(np.maximum(leg**2 - away**2, (0.35 * leg) ** 2))
        limits.append(feet[side].ankle[:, 2] + up - offset[:, 2])
    limit = np.minimum(*limits)
    high, level = lower_envelope(limit, ENVELOPE_S, fps), lower_envelope(limit, STEP_ENVELOPE_S, fps)
    apart = np.abs(feet["left"].ground[:, 2] - feet["right"].ground[:, 2])
    stairs = blur(np.clip(apart / STAIR_APART_M, 0.0, 1.0), 0.25, fps)
    share = LEVELLED * moving + (STAIRS_LEVELLED - LEVELLED * moving) * stairs
    running = blur(np.maximum(feet["left"].running, feet["right"].running).astype(np.float64), 0.15, fps)
    share += running * (1.0 - share)
    stands = blur((feet["left"].planted | feet["right"].planted).astype(np.float64), 0.045, fps)
    bounce = BOUNCE_M * running * (BOUNCE_MIDDLE - stands)
    wanted = np.minimum(high + share * (level - high) + bounce, high)
    return blur(falling_at_most(wanted, GRAVITY, fps), 0.02, fps)
