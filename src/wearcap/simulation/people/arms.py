"""Arms: swing against the legs, held postures, and hands that reach for points in the world."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.simulation.handling.grips import Grip
from wearcap.simulation.people.comfort import ArmBones, ArmPosture, elbow_pole, forearm_and_wrist, take
from wearcap.simulation.people.ik import two_bone
from wearcap.simulation.people.plan import LEFT_SIGN, Plan
from wearcap.simulation.people.posture import Trunk
from wearcap.simulation.people.track import blur, ease, wander

AROUND_S, TRACE = 0.7, 0.01
"""Time around a grip in which its place already has a little weight (s), against jumps, and that weight."""
ELBOW_POLE = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
"""Side of the upper arm, in its rest axes, to which the bent elbow points."""


@dataclass(frozen=True)
class ArmMotion:
    """World rotations of one arm's joints."""

    collar: Float[Tensor, "time 3 3"]
    shoulder: Float[Tensor, "time 3 3"]
    elbow: Float[Tensor, "time 3 3"]
    wrist: Float[Tensor, "time 3 3"]


def arm_motion(
    plan: Plan,
    side: str,
    trunk: Trunk,
    chest: Rigid,
    running: Float[np.ndarray, "time"],
    times: Float[np.ndarray, "time"],
    fps: float,
    rng: np.random.Generator,
) -> ArmMotion:
    """One arm over time. The wrist's path is mixed in space between swing, posture and goal, then solved for.

    `running` is 1 where the wearer runs, smooth between.
    """
    sign, hand, bones = LEFT_SIGN[side], plan.hands[side], arm_bones(plan.skeleton, side)
    lower, forearm, hinge, length = bones.upper, bones.fore, bones.hinge, bones.length
    R_world_chest = chest.R
    pose = hand.pose.sample(times)
    pose_weight = torch.from_numpy(hand.pose_weight.sample(times))
    goal = torch.from_numpy(hand.goal.sample(times))
    goal_weight = torch.from_numpy(hand.goal_weight.sample(times))

    R_swing, bend = _swing(plan, sign, trunk, running, times, fps, rng)
    held = held_wrist(plan, side, chest, times)
    aim = goal + (held.weight > 0)[:, None] * (held.wrist - goal)
    girdle = shoulder_girdle(plan, side, trunk, chest, aim, torch.maximum(goal_weight[:, 0], held.weight))
    at_shoulder = girdle.at_shoulder

    R_upper = R_world_chest @ R_swing
    wrist = _rotate(R_upper, lower + _rotate(rotation.exp(bend[:, None] * hinge), forearm.expand(len(times), 3)))
    mirror = torch.tensor([1.0, sign, 1.0], dtype=torch.float64)
    posed = torch.from_numpy(pose[:, :3].copy()) * mirror * length
    out = elbow_pole(torch.from_numpy(pose[:, 3].copy()), sign)
    pole = R_upper @ ELBOW_POLE
    wrist = wrist + pose_weight * (_rotate(R_world_chest, posed) - wrist)
    wrist = wrist + goal_weight * (goal - at_shoulder - wrist)
    strength = torch.maximum(pose_weight, goal_weight)
    pole = pole + strength * (_rotate(R_world_chest, out) - pole)
    grips = _gripped(plan, side, bones, chest, at_shoulder, times, fps)
    for part, share, taken in grips:
        wrist[part] += share[:, None] * (taken.wrist - at_shoulder[part] - wrist[part])
        pole[part] += share[:, None] * (_rotate(R_world_chest[part], elbow_pole(taken.swivel, sign)) - pole[part])
    R_shoulder, flexion = two_bone(lower, forearm, hinge, _shy_of_shoulder(wrist, length), pole)

    relaxed = wander(rng, len(times), 3, 3.0, 0.05, fps)
    turn = pose_weight[:, 0] * torch.from_numpy(pose[:, 4].copy()) + torch.from_numpy(relaxed[:, 0])
    fold = pose_weight[:, 0] * torch.from_numpy(pose[:, 5].copy()) + torch.from_numpy(relaxed[:, 1] + 0.06)
    R_forearm = R_shoulder @ rotation.exp(flexion[:, None] * hinge)
    R_elbow, R_hand = _turned(bones, R_forearm, turn, fold, grips)
    return ArmMotion(girdle.R_collar, R_shoulder, R_elbow, R_elbow @ R_hand)


def _turned(
    bones: ArmBones,
    R_forearm: Float[Tensor, "time 3 3"],
    turn: Float[Tensor, "time"],
    fold: Float[Tensor, "time"],
    grips: list[tuple[slice, Tensor, ArmPosture]],
) -> tuple[Float[Tensor, "time 3 3"], Float[Tensor, "time 3 3"]]:
    """The elbow's rotation in the world and the wrist's in the forearm: at ease, or as the grips have it."""
    axis, sign = bones.axis, bones.sign
    R_hand = rotation.exp(0.3 * sign * turn[:, None] * axis) @ rotation.about_axis("x", -sign * fold)
    turn = 0.7 * sign * turn
    for part, share, taken in grips:
        wanted_turn, wanted_bend = forearm_and_wrist(R_forearm[part], taken.hand, axis)
        turn[part] += share * (wanted_turn - turn[part])
        R_hand[part] = rotation.exp(torch.lerp(rotation.log(R_hand[part]), wanted_bend, share[:, None]))
    return R_forearm @ rotation.exp(turn[:, None] * axis), R_hand


def arm_bones(skeleton: Skeleton, side: str) -> ArmBones:
    """One arm's lengths and axes, in float64."""
    upper, fore = skeleton.t_parent_joint[skeleton.indices(f"{side}_elbow", f"{side}_wrist")].double()
    sign = LEFT_SIGN[side]
    hinge = torch.tensor([0.0, 0.0, -sign], dtype=torch.float64)
    palm = torch.tensor(skeleton.sites[f"{side}_palm"].t_joint_site, dtype=torch.float64)
    return ArmBones(upper, fore, hinge, palm, sign)


@dataclass(frozen=True)
class Girdle:
    """Rotation of the collar bone, and the position to which it carries the shoulder."""

    R_collar: Float[Tensor, "time 3 3"]
    at_shoulder: Float[Tensor, "time 3"]


def shoulder_girdle(
    plan: Plan, side: str, trunk: Trunk, chest: Rigid, goal: Float[Tensor, "time 3"], weight: Float[Tensor, "time"]
) -> Girdle:
    """The shoulder girdle; the shoulder follows a hand that is drawn to a goal in the world."""
    skeleton = plan.skeleton
    collar, shoulder = skeleton.t_parent_joint[skeleton.indices(f"{side}_collar", f"{side}_shoulder")].double()
    at_collar = chest.t + (chest.R @ collar)
    in_chest = _rotate(chest.R.transpose(-1, -2), goal - at_collar) - shoulder
    length = arm_bones(skeleton, side).length
    R_collar = chest.R @ _collar_turn(LEFT_SIGN[side], trunk, in_chest / length, weight)
    return Girdle(R_collar, at_collar + R_collar @ shoulder)


@dataclass(frozen=True)
class WristGoal:
    """Wrist goals that follow from the grips of one side."""

    wrist: Float[Tensor, "time 3"]
    """Approximate wrist position in the world (m); the chest's position where nothing is held."""
    weight: Float[Tensor, "time"]
    """Weight of the grip, 0…1."""
    near: Float[Tensor, "time"]
    """The same weight, but rising `AROUND_S` earlier and falling as much later."""


def held_wrist(plan: Plan, side: str, chest: Rigid, times: Float[np.ndarray, "time"]) -> WristGoal:
    """Wrist goals that follow from the grips of one side, with the hand turned as the grips prefer."""
    bones = arm_bones(plan.skeleton, side)
    wrist, free = torch.zeros_like(chest.t), torch.ones(2, len(times), dtype=torch.float64)
    total = torch.full_like(free[0], 1e-12)
    for grip in plan.grips[side]:
        part = slice(*np.searchsorted(times, (grip.start_s - AROUND_S, grip.stop_s + AROUND_S)).tolist())
        hold = grip.hold(np.clip(times[part], grip.start_s, grip.stop_s), chest[part])
        hand = hold.hand(bones.sign, torch.zeros(len(hold.palm), dtype=torch.float64))
        longer = replace(grip, reach_s=grip.reach_s + AROUND_S, return_s=grip.return_s + AROUND_S)
        weights = torch.from_numpy(np.stack([each.weight(times[part]) for each in (grip, longer)]))
        share = weights[0] + TRACE * weights[1]
        wrist[part] += share[:, None] * (hold.palm - hand @ bones.palm)
        total[part] += share
        free[:, part] *= 1.0 - weights
    none = (total < 1e-9)[:, None]
    weight, near = 1.0 - free
    return WristGoal(torch.where(none, chest.t, wrist / total[:, None]), weight, near)


def _gripped(
    plan: Plan,
    side: str,
    bones: ArmBones,
    chest: Rigid,
    at_shoulder: Float[Tensor, "time 3"],
    times: np.ndarray,
    fps: float,
) -> list[tuple[slice, Tensor, ArmPosture]]:
    """Grips of one side: the frames of each, its weight there, and how the arm takes it."""
    found = []
    for grip in plan.grips[side]:
        part, share = _span(grip, times)
        if part.start < part.stop:
            hold = grip.hold(times[part], chest[part])
            found.append((part, share, take(bones, hold, chest.R[part], at_shoulder[part], fps)))
    return found


def _span(grip: Grip, times: np.ndarray) -> tuple[slice, Tensor]:
    part = slice(*np.searchsorted(times, (grip.start_s, grip.stop_s)).tolist())
    return part, torch.from_numpy(grip.weight(times[part]))


def _rotate(R: Tensor, vector: Tensor) -> Tensor:
    return (R @ vector[..., None])[..., 0]


def _swing(
    plan: Plan, sign: float, trunk: Trunk, running: np.ndarray, times: np.ndarray, fps: float, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Rotation of the hanging upper arm in the chest, and the elbow's bend (rad)."""
    style = plan.style
    gain = style.arm_swing * (1.0 + sign * style.arm_symmetry)
    lag = round(0.04 * fps)
    delayed = np.concatenate([np.full(lag, trunk.stride[0]), trunk.stride])[: len(times)]
    ahead = -sign * blur(delayed, 0.07, fps)
    slow = wander(rng, len(times), 4, 4.0, 0.03, fps)
    walk, run = 1.0 - running, running
    swing = gain * ahead * (walk + 0.75 * run) + 0.05 - 0.30 * run + slow[:, 0]
    swing += 0.9 * (trunk.chest_angles[:, 1] - style.slouch)  # gravity pulls them down when the trunk leans
    spread = style.arm_spread + 0.05 * run + slow[:, 1]
    turn = style.arm_turn + 0.25 * run + slow[:, 2]
    elbow = style.elbow + walk * 0.07 * np.clip(trunk.speed, 0.0, 2.0) + 1.15 * run + slow[:, 3]
    elbow = elbow + (1.15 * walk + 0.25 * run) * _forward_part(swing)
    angles = [torch.from_numpy(np.ascontiguousarray(a)) for a in (swing, spread, turn, elbow)]
    about = rotation.about_axis
    hang = about("x", -sign * (np.pi / 2 - angles[1]))
    R = about("y", -angles[0]) @ hang @ about("y", angles[2])
    return R, angles[3].clamp(min=0.06)


def _forward_part(swing: np.ndarray) -> np.ndarray:
    """The swing where it is forward, decaying smoothly to zero where it is backward."""
    return 0.08 * np.logaddexp(0.0, swing / 0.08)


def _collar_turn(sign: float, trunk: Trunk, reach: Tensor, weight: Tensor) -> Tensor:
    """The shoulder girdle rises and comes forward with a hand that goes far; a trace of it moves with the swing."""
    distance = reach.norm(dim=-1).clamp(min=1e-3)
    steep = (reach[:, 2] / distance).numpy()
    far = torch.from_numpy(ease((distance.numpy() - 0.65) / 0.5))
    lift = weight * torch.from_numpy(0.38 * ease((steep + 0.7) / 1.7)) * (0.4 + 0.6 * far)
    front = weight * 0.28 * far * (reach[:, 0] / distance).clamp(-1.0, 1.0)
    front = front - sign * 0.05 * torch.from_numpy(trunk.stride)
    return rotation.about_axis("z", -sign * front) @ rotation.about_axis("x", sign * lift)


def _shy_of_shoulder(wrist: Tensor, length: float) -> Tensor:
    """Wrist relative to the shoulder, kept so far off that the elbow bends no more than about 150 degrees."""
    distance = wrist.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return wrist * (distance.clamp(min=0.27 * length) / distance)
