"""Arms: swing against the legs, held postures, and hands that reach for points in the world."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.simulation.ik import two_bone
from wearcap.simulation.plan import LEFT_SIGN, Plan
from wearcap.simulation.posture import Trunk
from wearcap.simulation.track import blur, ease, wander

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
    R_world_chest: Float[Tensor, "time 3 3"],
    t_world_chest: Float[Tensor, "time 3"],
    running: Float[np.ndarray, "time"],
    times: Float[np.ndarray, "time"],
    fps: float,
    rng: np.random.Generator,
) -> ArmMotion:
    """One arm over time. The wrist's way is mixed in space between swing, posture and goal, then solved for.

    `running` is 1 where the wearer runs, smooth between.
    """
    skeleton, sign, hand = plan.skeleton, LEFT_SIGN[side], plan.hands[side]
    collar, upper, lower = (
        skeleton.t_parent_joint[skeleton.index(f"{side}_{joint}")].double()
        for joint in ("collar", "shoulder", "elbow")
    )
    forearm = skeleton.t_parent_joint[skeleton.index(f"{side}_wrist")].double()
    length = float(lower.norm() + forearm.norm())
    pose = hand.pose.sample(times)
    pose_weight = torch.from_numpy(hand.pose_weight.sample(times))
    goal = torch.from_numpy(hand.goal.sample(times))
    goal_weight = torch.from_numpy(hand.goal_weight.sample(times))

    R_swing, bend = _swing(plan, sign, trunk, running, times, fps, rng)
    at_collar = t_world_chest + (R_world_chest @ collar)
    in_chest = _rotate(R_world_chest.transpose(-1, -2), goal - at_collar) - upper
    R_collar = R_world_chest @ _collar_turn(sign, trunk, in_chest / length, goal_weight[:, 0])
    at_shoulder = at_collar + R_collar @ upper

    hinge = torch.tensor([0.0, 0.0, -sign], dtype=torch.float64)
    R_upper = R_world_chest @ R_swing
    wrist = _rotate(
        R_upper, lower + _rotate(rotation.exp(bend[:, None] * hinge), forearm.expand(len(times), 3))
    )
    mirror = torch.tensor([1.0, sign, 1.0], dtype=torch.float64)
    held = torch.from_numpy(pose[:, :3].copy()) * mirror * length
    swivel = torch.from_numpy(pose[:, 3].copy())
    out = torch.stack([torch.full_like(swivel, -0.35), sign * swivel.sin(), -swivel.cos()], -1)
    pole = R_upper @ ELBOW_POLE
    wrist = wrist + pose_weight * (_rotate(R_world_chest, held) - wrist)
    wrist = wrist + goal_weight * (goal - at_shoulder - wrist)
    strength = torch.maximum(pose_weight, goal_weight)
    pole = pole + strength * (_rotate(R_world_chest, out) - pole)
    R_shoulder, flexion = two_bone(lower, forearm, hinge, _shy_of_shoulder(wrist, length), pole)

    relaxed = wander(rng, len(times), 3, 3.0, 0.05, fps)
    turn = pose_weight[:, 0] * torch.from_numpy(pose[:, 4].copy()) + torch.from_numpy(relaxed[:, 0])
    fold = pose_weight[:, 0] * torch.from_numpy(pose[:, 5].copy()) + torch.from_numpy(relaxed[:, 1] + 0.06)
    axis = forearm / forearm.norm()
    R_elbow = (
        R_shoulder @ rotation.exp(flexion[:, None] * hinge) @ rotation.exp(0.7 * sign * turn[:, None] * axis)
    )
    R_hand = rotation.exp(0.3 * sign * turn[:, None] * axis) @ rotation.about_axis("x", -sign * fold)
    return ArmMotion(R_collar, R_shoulder, R_elbow, R_elbow @ R_hand)


def _rotate(R: Tensor, vector: Tensor) -> Tensor:
    return (R @ vector[..., None])[..., 0]


def _swing(
    plan: Plan,
    sign: float,
    trunk: Trunk,
    running: np.ndarray,
    times: np.ndarray,
    fps: float,
    rng: np.random.Generator,
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
    """The swing where it is forward, smoothly nothing where it is backward."""
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
    """Wrist from the shoulder, kept so far off that the elbow bends no more than about 150 degrees."""
    distance = wrist.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return wrist * (distance.clamp(min=0.27 * length) / distance)
