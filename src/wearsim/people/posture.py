"""The trunk over the feet: a pendulum's centre of mass, a pelvis that the legs can carry, a counter-turning chest.

Above it the head, whose gaze is ahead of the coming turn, in saccades, and at objects that are reached for.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearsim.people.gait import Feet
from wearsim.people.plan import SIDES, Plan, wrap
from wearsim.people.track import blur, falling_at_most, lower_envelope, pendulum, wander

SPINE = ("l5", "l3", "t12", "t8")
GRAVITY = 9.81
ENVELOPE_S = 0.06
STEP_ENVELOPE_S, LEVELLED = 0.26, 0.12
"""Share by which the pelvis stays nearer in walking to the height that it can keep over a whole step."""
STAIR_APART_M, STAIRS_LEVELLED = 0.15, 0.5
"""On stairs (feet so far apart in height) knees bend more, which evens out the pelvis' path."""
BOUNCE_M, BOUNCE_MIDDLE = 0.12, 0.68
"""In running the pelvis is lowest over the bent standing leg and rises in flight: by how much, about which load."""
HIPS_AHEAD_M = 0.096
"""Additional forward offset of the hips in walking, relative to standing."""
STANCE_BEND = 0.9
"""More bend of a bearing knee in walking than in standing, as a share of the knee's softness."""
STRIKE_BEND, STRAIGHTEST = 0.104, 0.065
"""Bend of the knee over which the pelvis walks, and the least bend that it leaves to either knee (rad)."""
HAND_OVER_S = 0.07
"""Spread of the time about a landing in which the other leg takes the pelvis over."""
HELP = ("lean", "bend", "twist", "crouch", "ahead", "aside")
"""Trunk motions that help hands to reach, columns of `help_`: as `Plan.lean` (rad), `crouch` and `shift` (m)."""
LEAD_S = 0.32
"""Lead of the gaze over a turn of the body."""
YAW_LIMIT = 1.15
PITCH_LIMITS = (-0.75, 0.95)


def rotation_of(angles: Float[np.ndarray, "time 3"]) -> Float[Tensor, "time 3 3"]:
    """Matrix of yaw, pitch and roll: Rz Ry Rx."""
    yaw, pitch, roll = torch.from_numpy(np.ascontiguousarray(angles)).unbind(-1)
    about = rotation.about_axis
    return about("z", yaw) @ about("y", pitch) @ about("x", roll)


@dataclass(frozen=True)
class Stance:
    """Quantities that follow from the feet before the trunk is placed over them, with all random draws."""

    feet: Feet
    heading: Float[np.ndarray, "time"]
    load: Float[np.ndarray, "time"]
    """Share of the weight on the left foot."""
    mass: Float[np.ndarray, "time 2"]
    """Position of the centre of mass over the floor (m)."""
    speed: Float[np.ndarray, "time"]
    acceleration: Float[np.ndarray, "time 2"]
    stride: Float[np.ndarray, "time"]
    """Left foot ahead of the right one (m), smooth."""
    drift: Float[np.ndarray, "time 6"]

    @classmethod
    def of(cls, feet: Feet, rng: np.random.Generator) -> "Stance":
        """Motion of the wearer's mass over the feet."""
        plan, fps, count = feet.plan, feet.fps, len(feet.times)
        heading = blur((feet.left.heading + feet.right.heading) / 2, 0.13, fps)
        forward = np.stack([np.cos(heading), np.sin(heading)], 1)
        load = feet.load_on_left(rng)
        pressure = load[:, None] * feet.left.pressure + (1 - load[:, None]) * feet.right.pressure
        pressure = pressure[:, :2] + wander(rng, count, 2, 2.2, plan.style.posture.sway, fps)
        rate = float(np.sqrt(GRAVITY / (1.06 * plan.hip_height)))
        mass = pendulum(pressure, rate, fps)
        velocity = np.gradient(mass, axis=0) * fps
        speed = blur((velocity * forward).sum(1), 0.3, fps)
        acceleration = blur(rate**2 * (mass - pressure), 0.1, fps)
        stride = blur(((feet.left.ankle - feet.right.ankle)[:, :2] * forward).sum(1), 0.06, fps)
        return cls(feet, heading, load, mass, speed, acceleration, stride, wander(rng, count, 6, 2.5, 0.010, fps))


@dataclass(frozen=True)
class Trunk:
    """Pelvis and chest over time; angles are yaw, forward pitch and roll to the right in the world (rad)."""

    stance: Stance
    pelvis: Float[np.ndarray, "time 3"]
    pelvis_angles: Float[np.ndarray, "time 3"]
    chest_angles: Float[np.ndarray, "time 3"]

    @classmethod
    def over(cls, stance: Stance, help_: Float[np.ndarray, "time 6"] | None = None) -> "Trunk":
        """Pelvis and chest that follow from the feet, the plan's channels, the wearer's habits and the hands' need."""
        plan, times, fps = stance.feet.plan, stance.feet.times, stance.feet.fps
        style, heading, stride, drift = plan.style.posture, stance.heading, stance.stride, stance.drift
        forward = np.stack([np.cos(heading), np.sin(heading)], 1)
        seated = plan.seat_weight.sample(times)
        moving = np.clip(np.abs(stance.speed) / 0.8, 0.0, 1.0)
        lean, crouch, shift = plan.lean.sample(times), plan.crouch.sample(times)[:, 0], plan.shift.sample(times)
        if help_ is not None:
            lean, crouch, shift = lean + help_[:, :3], crouch + help_[:, 3], shift + help_[:, 4:]

        # the pelvis drops on the side that swings: it rolls to the right while the left leg stands
        drops = style.pelvis_list * (0.35 + 0.65 * moving) * np.sin(np.pi * (blur(stance.load, 0.05, fps) - 0.5))
        pelvis_angles = np.stack(
            [
                heading - style.pelvis_yaw * stride * (1 - seated[:, 0]) + 0.3 * lean[:, 2],
                style.pelvis_tilt * (0.4 + 0.6 * moving) + 0.45 * lean[:, 0] + drift[:, 0],
                drops + 0.15 * lean[:, 1],
            ],
            1,
        )
        across = np.stack([-forward[:, 1], forward[:, 0]], 1)
        sideways = (stance.acceleration * across).sum(1)
        speeding = blur((stance.acceleration * forward).sum(1), 0.12, fps)
        chest_angles = np.stack(
            [
                heading + style.trunk_counter * style.pelvis_yaw * blur(stride, 0.05, fps) + lean[:, 2] + drift[:, 1],
                style.slouch + 0.035 * stance.speed + 0.03 * speeding + lean[:, 0] + drift[:, 2],
                -0.35 * pelvis_angles[:, 2] - 0.025 * sideways + lean[:, 1] + drift[:, 3],
            ],
            1,
        )
        back = 0.26 * plan.hip_height * np.sin(np.clip(lean[:, 0], -0.5, 1.5)) + 0.012 - HIPS_AHEAD_M * moving
        place = stance.mass - back[:, None] * forward
        place = place + shift[:, :1] * forward + shift[:, 1:] * across
        seat = plan.seat.sample(times)
        place += seated[:, :1] * (seat[:, :2] - place)
        height = _height(stance.feet, place, moving, rotation_of(pelvis_angles)) - crouch
        height += seated[:, 1] * (seat[:, 2] - height)
        return cls(stance, np.concatenate([place, height[:, None]], 1), pelvis_angles, chest_angles)

    @cached_property
    def spine(self) -> tuple[Float[Tensor, "time joint 3 3"], Rigid]:
        """World rotations of the joints of `SPINE` in order, the last one the chest's, and the chest's pose.

        The turn between pelvis and chest is shared evenly among them.
        """
        skeleton = self.stance.feet.plan.skeleton
        R_pelvis, R_chest = rotation_of(self.pelvis_angles), rotation_of(self.chest_angles)
        between = rotation.log(R_pelvis.transpose(-1, -2) @ R_chest)
        position, rotations = torch.from_numpy(self.pelvis), [R_pelvis]
        for number, name in enumerate(SPINE, start=1):
            position = position + rotations[-1] @ skeleton.t_parent_joint[skeleton.index(name)].double()
            rotations.append(R_pelvis @ rotation.exp(number / len(SPINE) * between))
        R_world = torch.stack(rotations[1:], 1)
        return R_world, Rigid(R_world[:, -1], position)

    @property
    def chest(self) -> Rigid:
        """Pose of the chest."""
        return self.spine[1]


def _height(
    feet: Feet,
    place: Float[np.ndarray, "time 2"],
    moving: Float[np.ndarray, "time"],
    R_world_pelvis: Float[Tensor, "time 3 3"],
) -> Float[np.ndarray, "time"]:
    """Height of the pelvis (m).

    In level walking the leg that landed last carries it, as a pole with a knee that yields a little; else it is as high
    as both legs let it, with soft knees, and smooth.
    """
    fps, left, right = feet.fps, feet.left, feet.right
    soft, found = feet.plan.style.gait.knee_soft, []
    for side in SIDES:
        bears = blur(feet[side].planted.astype(np.float64), 0.08, fps)
        bent = soft * (0.25 + (0.25 + STANCE_BEND * moving) * bears)
        bends = np.stack([bent, STRIKE_BEND + feet[side].yielding, np.full_like(bent, STRAIGHTEST)])
        found.append(_heights(feet, side, place, R_world_pelvis, bends))
    (limit, _, top), (_, (pole_left, pole_right), _) = np.minimum(*found), np.stack(found, 1)
    high, level = lower_envelope(limit, ENVELOPE_S, fps), lower_envelope(limit, STEP_ENVELOPE_S, fps)
    stairs = blur(np.clip(np.abs(left.ground[:, 2] - right.ground[:, 2]) / STAIR_APART_M, 0.0, 1.0), 0.25, fps)
    share = LEVELLED * moving + (STAIRS_LEVELLED - LEVELLED * moving) * stairs
    running = blur(np.maximum(left.running, right.running).astype(np.float64), 0.15, fps)
    share += running * (1.0 - share)
    stands = blur((left.planted | right.planted).astype(np.float64), 0.045, fps)
    bounce = BOUNCE_M * running * (BOUNCE_MIDDLE - stands)
    wanted = np.minimum(high + share * (level - high) + bounce, high)
    wanted = blur(falling_at_most(wanted, GRAVITY, fps), 0.02, fps)
    # the pole goes over from leg to leg about each landing
    on_left = blur((left.landed_s > right.landed_s).astype(np.float64), HAND_OVER_S, fps)
    walked = blur(pole_right + on_left * (pole_left - pole_right), 0.022, fps)
    level_ground = 1.0 - blur((left.climbs | right.climbs).astype(np.float64), 0.12, fps)
    walks = moving * (1.0 - running) * level_ground
    wanted += walks * (walked - wanted)
    return wanted + lower_envelope(np.minimum(top - wanted, 0.0), ENVELOPE_S, fps)


def _heights(
    feet: Feet,
    side: str,
    place: Float[np.ndarray, "time 2"],
    R_world_pelvis: Float[Tensor, "time 3 3"],
    bends: Float[np.ndarray, "bend time"],
) -> Float[np.ndarray, "bend time"]:
    """Heights of the pelvis (m) over one leg, each for a bend of its knee (rad)."""
    hip, knee, ankle = feet.plan.bones(f"{side}_hip", f"{side}_knee", f"{side}_ankle")
    turns = torch.zeros(*bends.shape, 3, dtype=torch.float64)
    turns[..., 1] = torch.from_numpy(bends)
    leg = (knee + (rotation.exp(turns) @ ankle[:, None])[..., 0]).norm(dim=-1).numpy()
    offset = (R_world_pelvis @ hip).numpy()
    away = np.linalg.norm(feet[side].ankle[:, :2] - place - offset[:, :2], axis=1)
    up = np.sqrt(np.maximum(leg**2 - away**2, (0.35 * leg) ** 2))
    return feet[side].ankle[:, 2] + up - offset[:, 2]


def look_about(
    plan: Plan, start_s: float, stop_s: float, rng: np.random.Generator, spread: float = 0.5, pause_s: float = 1.6
) -> None:
    """Head turns of 10 to 60 degrees every 1 to 4 s between two times, back to the front at the end.

    `spread` is the deviation of the yaw (rad), `pause_s` the mean pause between turns (s).
    """
    time = start_s + rng.uniform(0.2, 1.0) * pause_s
    pitch = plan.style.posture.head_pitch
    while time < stop_s - 1.2:
        yaw, down = rng.normal(0.0, spread), pitch + rng.normal(0.0, 0.35 * spread)
        if rng.random() < 0.3:
            yaw, down = 0.15 * yaw, pitch
        time = turn_head(plan, time, np.clip(yaw, -1.2, 1.2), np.clip(down, -0.5, 0.8))
        time += pause_s * (0.35 + rng.exponential(0.75))
    turn_head(plan, max(stop_s - 0.6, start_s))


def turn_head(plan: Plan, start_s: float, yaw: float = 0.0, pitch: float | None = None) -> float:
    """One head turn to a yaw and pitch (rad; None is the wearer's habit). Returns the time (s) at which it ends.

    Its duration grows with its size.
    """
    target = yaw, plan.style.posture.head_pitch if pitch is None else pitch
    size = float(np.abs(np.array(target) - plan.gaze.last).max())
    stop = start_s + (0.22 + 0.45 * size) / plan.style.briskness
    plan.gaze.move(start_s, stop, target)
    return stop


def look_at(
    plan: Plan, point: Float[np.ndarray, "3"], on: tuple[float, float], off: tuple[float, float], weight: float = 0.9
) -> None:
    """Turn the gaze to a point in the world (m) in one interval of time and off it in another (s)."""
    plan.gaze_point.move(on[0], on[0], point)
    plan.gaze_weight.visit(weight, on, off)


def head_angles(
    trunk: Trunk, eyes: Float[np.ndarray, "time 3"], rng: np.random.Generator
) -> Float[np.ndarray, "time 3"]:
    """Yaw, pitch (down positive) and roll of the head in the world (rad), given the approximate eye position (m).

    The head is stabilised against the trunk's swing but for a small share, and pitches against its own bob as eyes
    fixed on a point some metres ahead do.
    """
    stance, chest = trunk.stance, trunk.chest_angles
    plan, times, fps, heading = stance.feet.plan, stance.feet.times, stance.feet.fps, stance.heading
    lead = round(LEAD_S * fps)
    ahead = np.concatenate([heading[lead:], np.full(min(lead, len(heading)), heading[-1])])[: len(heading)]
    offset = plan.gaze.sample(times)
    bob = eyes[:, 2] - blur(eyes[:, 2], 0.6, fps)
    noise = wander(rng, len(times), 3, 0.9, 0.012, fps)
    steady = blur(chest, 0.5, fps)
    yaw = blur(ahead, 0.09, fps) + offset[:, 0] + 0.12 * (chest[:, 0] - steady[:, 0]) + noise[:, 0]
    pitch = offset[:, 1] + 0.10 * (chest[:, 1] - steady[:, 1]) + bob / 2.5 + noise[:, 1]
    pitch += 0.35 * np.clip(steady[:, 1] - 0.15, 0.0, None)
    point, weight = plan.gaze_point.sample(times) - eyes, plan.gaze_weight.sample(times)[:, 0]
    toward = np.arctan2(point[:, 1], point[:, 0])
    down = np.arctan2(-point[:, 2], np.linalg.norm(point[:, :2], axis=1))
    relative = yaw - chest[:, 0]
    relative += weight * (np.clip(wrap(toward - chest[:, 0]), -1.4, 1.4) - relative)
    pitch += weight * (down - pitch)
    relative = YAW_LIMIT * np.tanh(relative / YAW_LIMIT)
    middle, half = sum(PITCH_LIMITS) / 2, (PITCH_LIMITS[1] - PITCH_LIMITS[0]) / 2
    pitch = middle + half * np.tanh((pitch - middle) / half)
    return np.stack([chest[:, 0] + relative, pitch, 0.25 * chest[:, 2] + noise[:, 2]], 1)
