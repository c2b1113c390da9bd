"""The simulated wearer: activities are planned one after the other, then the whole body's motion follows at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry import rotation
from wearcap.recording.motion import Motion
from wearsim.people.actions import ACTIVITIES, start_place
from wearsim.people.arms import arm_motion, reach_help, two_bone
from wearsim.people.gait import Feet
from wearsim.people.person import Person
from wearsim.people.plan import SIDES, Label, Plan
from wearsim.people.posture import SPINE, Stance, Trunk, head_angles, rotation_of
from wearsim.people.track import blur
from wearsim.places.world import World

NECK_SHARE = 0.45
TOUCH_M = 0.02
"""Height of a patch above the floor below which it can touch it: a heel or toes may stand over a stair's edge."""
TAIL_S = 1.5
"""Time simulated beyond the end and cut off, because a body in motion looks this far ahead."""


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
    person: Person,
    rng: np.random.Generator,
    duration_s: float,
    fps: float = 60.0,
    activities: Sequence[str] | None = None,
) -> SimulatedMotion:
    """A person's whole-body motion in a world, deterministic for a given state of `rng`.

    `activities` names entries of `actions.ACTIVITIES` to be done in turn, repeatedly until the time is reached;
    None draws them at random by their weights.
    """
    plan = Plan(person, *start_place(world, rng), world.floor_height)
    names = list(ACTIVITIES)
    weights = np.array([each.weight * (each.outdoors if world.outdoors else 1.0) for each in ACTIVITIES.values()])
    while plan.time < duration_s + TAIL_S:
        if activities is not None:
            name = activities[len(plan.labels) % len(activities)]
        else:
            name = names[rng.choice(len(names), p=weights / weights.sum())]
        start = plan.time
        if not plan.labels:
            plan.time += 0.3
        done = ACTIVITIES[name].act(plan, world, rng)
        if not done:
            ACTIVITIES["stand"].act(plan, world, rng)
        plan.label(start, name if done else "stand")
    return perform(plan, world, rng, duration_s, fps)


def perform(plan: Plan, world: World, rng: np.random.Generator, duration_s: float, fps: float) -> SimulatedMotion:
    """The motion that a plan describes; the plan should reach `TAIL_S` beyond the duration."""
    skeleton, count = plan.skeleton, round(duration_s * fps)
    times = np.arange(count + round(TAIL_S * fps)) / fps
    feet = Feet.of(plan, times, fps)
    stance = Stance.of(feet, rng)
    trunk = Trunk.over(stance, reach_help(stance))
    motion = Motion(
        timestamps=torch.from_numpy(times),
        skeleton=skeleton,
        R_parent_joint=local_rotations(skeleton, _body(trunk, rng)).float(),
        t_world_root=torch.from_numpy(trunk.pelvis).float(),
        provenance={"source": "simulated wearer"},
    ).sliced(0, count)
    sites = [skeleton.sites[name] for name in FOOT_PATCHES]
    patches = torch.stack([motion.joint(site.joint) @ torch.tensor(site.t_joint_site) for site in sites], 1)
    patches = patches.double().numpy()
    over_floor = patches[..., 2] - world.floor_height(patches[..., :2], patches[..., 2]) < TOUCH_M
    contact = torch.from_numpy(np.concatenate([feet[side].contact[:count] for side in SIDES], 1) & over_floor)
    floor = np.mean([blur(feet[side].ground[:, 2], 0.1, fps)[:count] for side in SIDES], 0)
    labels = tuple(label for label in plan.labels if label.start_s < duration_s)
    motion = replace(motion, contact_prob=contact.float())
    return SimulatedMotion(motion, contact, torch.from_numpy(floor).float(), labels)


def _body(trunk: Trunk, rng: np.random.Generator) -> Float[Tensor, "time joint 3 3"]:
    """World rotations of all joints."""
    feet, chest = trunk.stance.feet, trunk.chest
    skeleton = feet.plan.skeleton
    R = torch.eye(3, dtype=torch.float64).repeat(len(feet.times), len(skeleton), 1, 1)
    R[:, skeleton.index("pelvis")] = rotation_of(trunk.pelvis_angles)
    R[:, skeleton.indices(*SPINE)] = trunk.spine[0]

    neck, head = feet.plan.bones("neck", "head")
    eyes = chest.t + chest.R @ (neck + head) + torch.tensor([0.0, 0.0, 0.1])
    R_head = rotation_of(head_angles(trunk, eyes.numpy(), rng))
    R[:, skeleton.index("head")] = R_head
    between = rotation.log(chest.R.transpose(-1, -2) @ R_head)
    R[:, skeleton.index("neck")] = chest.R @ rotation.exp(NECK_SHARE * between)

    running = blur(np.mean([feet[side].running for side in SIDES], 0), 0.15, feet.fps)
    for side in SIDES:
        # hip and knee carry the pelvis over the ankle; foot and toes are as planned
        foot = feet[side]
        hip, knee, ankle = feet.plan.bones(f"{side}_hip", f"{side}_knee", f"{side}_ankle")
        heading, body = torch.from_numpy(foot.heading), torch.from_numpy(trunk.pelvis_angles[:, 0].copy())
        zero = torch.zeros_like(heading)
        pole = 0.65 * torch.stack([heading.cos(), heading.sin(), zero + 0.35], -1)
        pole = pole + 0.35 * torch.stack([body.cos(), body.sin(), zero + 0.35], -1)
        target = torch.from_numpy(foot.ankle - trunk.pelvis) - rotation_of(trunk.pelvis_angles) @ hip
        hinge = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        R_hip, bend = two_bone(knee, ankle, hinge, target, pole)
        flat = np.zeros_like(foot.pitch)
        leg = {
            "hip": R_hip,
            "knee": R_hip @ rotation.exp(bend[:, None] * hinge),
            "ankle": rotation_of(np.stack([foot.heading, foot.pitch, flat], 1)),
            "toe": rotation_of(np.stack([foot.heading, foot.pitch - foot.toe_bend, flat], 1)),
        }
        for joint, R_joint in (arm_motion(trunk, side, running, rng) | leg).items():
            R[:, skeleton.index(f"{side}_{joint}")] = R_joint
    return R
