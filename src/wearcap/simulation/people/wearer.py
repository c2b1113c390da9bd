"""The simulated wearer: activities are planned one after the other, then the whole body's motion follows at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.geometry import rotation
from wearcap.recording.motion import Motion
from wearcap.simulation.people import hands, settle
from wearcap.simulation.people.actions import ACTIVITIES, start_place
from wearcap.simulation.people.arms import ArmMotion, arm_motion
from wearcap.simulation.people.gait import FootMotion, FootShape, foot_motion
from wearcap.simulation.people.gaze import head_angles
from wearcap.simulation.people.ik import two_bone
from wearcap.simulation.people.plan import SIDES, Label, Plan
from wearcap.simulation.people.posture import SPINE, Trunk, rotation_of, spine_motion, stance_motion, trunk_motion
from wearcap.simulation.people.reach_help import reach_help
from wearcap.simulation.people.style import Style
from wearcap.simulation.people.track import blur
from wearcap.simulation.places.world import World

__all__ = ["SimulatedMotion", "hands", "settle", "simulate_motion"]
"""`hands` and `settle` are imported because that registers their activities."""

NECK_SHARE = 0.45
TOUCH_M = 0.02
TAIL_S = 1.5
"""Time simulated beyond the end and cut off, because a body in motion looks this far ahead."""


@runtime_checkable
class Wearer(Protocol):
    """A wearer: a skeleton with the person's own bones (xsens23's joints), and habits of moving."""

    @property
    def skeleton(self) -> Skeleton: ...
    @property
    def style(self) -> Style: ...


@dataclass(frozen=True)
class SimulatedMotion:
    """A motion with its ground truth."""

    motion: Motion
    contact: Bool[Tensor, "time patch"]
    """Contact of `FOOT_PATCHES`."""
    floor_height: Float[Tensor, "time"]
    """Height of the floor below the wearer (m)."""
    labels: tuple[Label, ...]
    """Activities with their times, in order."""


def simulate_motion(
    world: World,
    person: Wearer,
    rng: np.random.Generator,
    duration_s: float,
    fps: float = 60.0,
    activities: Sequence[str] | None = None,
) -> SimulatedMotion:
    """A person's whole-body motion in a world, deterministic for a given state of `rng`.

    `activities` names entries of `actions.ACTIVITIES` to be done in turn, repeatedly until the time is reached;
    None draws them at random by their weights.
    """
    plan = _plan(world, person, rng, duration_s + TAIL_S, activities)
    return perform(plan, world, rng, duration_s, fps)


def perform(plan: Plan, world: World, rng: np.random.Generator, duration_s: float, fps: float) -> SimulatedMotion:
    """The motion that a plan describes; the plan should reach `TAIL_S` beyond the duration."""
    skeleton = plan.skeleton
    count = round(duration_s * fps)
    times = np.arange(count + round(TAIL_S * fps)) / fps
    feet = {
        side: foot_motion(plan.prints[side], FootShape.of(skeleton, side), plan.heel_lift[side], times)
        for side in SIDES
    }
    stance = stance_motion(plan, feet, times, fps, rng)
    trunk = trunk_motion(plan, feet, stance, times, fps, reach_help(plan, feet, stance, times, fps))
    R_world_joint = _body(plan, feet, trunk, times, fps, rng)
    motion = Motion(
        timestamps=torch.from_numpy(times),
        skeleton=skeleton,
        R_parent_joint=local_rotations(skeleton, R_world_joint).float(),
        t_world_root=torch.from_numpy(trunk.pelvis).float(),
        provenance={"source": "simulated wearer"},
    ).sliced(0, count)
    planted = torch.from_numpy(np.concatenate([feet[side].contact[:count] for side in SIDES], 1))
    contact = planted & _over_floor(world, motion)
    motion = replace(motion, contact_prob=contact.float())
    floor = np.mean([blur(feet[side].ground[:, 2], 0.1, fps)[:count] for side in SIDES], 0)
    labels = tuple(label for label in plan.labels if label.start_s < duration_s)
    return SimulatedMotion(motion, contact, torch.from_numpy(floor).float(), labels)


def _over_floor(world: World, motion: Motion) -> Bool[Tensor, "time patch"]:
    """Whether the floor is close below each patch: a heel or toes may stand over a stair's edge."""
    sites = [motion.skeleton.sites[name] for name in FOOT_PATCHES]
    patches = torch.stack([motion.joint(site.joint) @ torch.tensor(site.t_joint_site) for site in sites], 1)
    points = patches.double().numpy()
    return torch.from_numpy(points[..., 2] - world.floor_height(points[..., :2], points[..., 2]) < TOUCH_M)


def _plan(
    world: World, person: Wearer, rng: np.random.Generator, duration_s: float, activities: Sequence[str] | None
) -> Plan:
    position, heading = start_place(world, rng)
    plan = Plan(person.skeleton, person.style, position, heading, world.floor_height)
    weights = np.array(
        [activity.weight * (activity.outdoors if world.outdoors else 1.0) for activity in ACTIVITIES.values()]
    )
    names, turn = list(ACTIVITIES), 0
    while plan.time < duration_s:
        if activities is not None:
            name = activities[turn % len(activities)]
        else:
            name = names[rng.choice(len(names), p=weights / weights.sum())]
        start = plan.time
        if turn == 0:
            plan.time += 0.3
        done = ACTIVITIES[name].act(plan, world, rng)
        if not done:
            ACTIVITIES["stand"].act(plan, world, rng)
        plan.label(start, name if done else "stand")
        turn += 1
    return plan


def _body(
    plan: Plan,
    feet: dict[str, FootMotion],
    trunk: Trunk,
    times: Float[np.ndarray, "time"],
    fps: float,
    rng: np.random.Generator,
) -> Float[Tensor, "time joint 3 3"]:
    """World rotations of all joints."""
    skeleton = plan.skeleton
    R = torch.eye(3, dtype=torch.float64).repeat(len(times), len(skeleton), 1, 1)
    R[:, skeleton.index("pelvis")] = rotation_of(trunk.pelvis_angles)
    spine = spine_motion(skeleton, trunk)
    R[:, skeleton.indices(*SPINE)] = spine.R_world
    R_chest, t_chest = spine.chest.R, spine.chest.t

    neck, head = skeleton.t_parent_joint[skeleton.indices("neck", "head")].double()
    eyes = t_chest + R_chest @ (neck + head) + torch.tensor([0.0, 0.0, 0.1])
    angles = head_angles(plan, times, fps, trunk.heading, trunk.chest_angles, eyes.numpy(), rng)
    R_head = rotation_of(angles)
    R[:, skeleton.index("head")] = R_head
    between = rotation.log(R_chest.transpose(-1, -2) @ R_head)
    R[:, skeleton.index("neck")] = R_chest @ rotation.exp(NECK_SHARE * between)

    running = blur(np.mean([feet[side].running for side in SIDES], 0), 0.15, fps)
    for side in SIDES:
        arm = arm_motion(plan, side, trunk, spine.chest, running, times, fps, rng)
        _set_arm(skeleton, R, side, arm)
        _leg(skeleton, R, side, feet[side], trunk)
    return R


def _set_arm(skeleton: Skeleton, R: Tensor, side: str, arm: ArmMotion) -> None:
    for joint in ("collar", "shoulder", "elbow", "wrist"):
        R[:, skeleton.index(f"{side}_{joint}")] = getattr(arm, joint)


def _leg(skeleton: Skeleton, R: Tensor, side: str, foot: FootMotion, trunk: Trunk) -> None:
    """Rotations of hip and knee that carry the pelvis over the ankle, and of foot and toes as planned."""
    hip, knee, ankle = (
        skeleton.t_parent_joint[skeleton.index(f"{side}_{joint}")].double() for joint in ("hip", "knee", "ankle")
    )
    heading, body = torch.from_numpy(foot.heading), torch.from_numpy(trunk.pelvis_angles[:, 0].copy())
    zero = torch.zeros_like(heading)
    pole = 0.65 * torch.stack([heading.cos(), heading.sin(), zero + 0.35], -1)
    pole = pole + 0.35 * torch.stack([body.cos(), body.sin(), zero + 0.35], -1)
    R_pelvis = R[:, skeleton.index("pelvis")]
    target = torch.from_numpy(foot.ankle - trunk.pelvis) - R_pelvis @ hip
    hinge = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    R_hip, bend = two_bone(knee, ankle, hinge, target, pole)
    angles = np.stack([foot.heading, foot.pitch, np.zeros_like(foot.pitch)], 1)
    toes = np.stack([foot.heading, foot.pitch - foot.toe_bend, np.zeros_like(foot.pitch)], 1)
    R[:, skeleton.index(f"{side}_hip")] = R_hip
    R[:, skeleton.index(f"{side}_knee")] = R_hip @ rotation.exp(bend[:, None] * hinge)
    R[:, skeleton.index(f"{side}_ankle")] = rotation_of(angles)
    R[:, skeleton.index(f"{side}_toe")] = rotation_of(toes)
