"""A level floor and checks shared by the tests of hands that hold objects."""

import numpy as np
import torch

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry import rotation
from wearcap.recording.motion import Motion
from wearsim.people.arms import forearm_and_wrist
from wearsim.people.person import Person
from wearsim.people.plan import SIDES, Plan
from wearsim.people.wearer import SimulatedMotion, perform
from wearsim.places.builder import WorldBuilder
from wearsim.places.world import World

FPS = 60.0


def level_world() -> World:
    """A floor of 12 m by 12 m with a post in a far corner."""
    builder = WorldBuilder("level")
    square = [(-6.0, -6.0), (6.0, -6.0), (6.0, 6.0), (-6.0, 6.0)]
    builder.add_surface("floor", square, (0.5, 0.5, 0.5))
    builder.add_block("post", (5.5, 5.5, 1.0), (0.1, 0.1, 2.0), (0.5, 0.5, 0.5))
    return builder.finish(0.25)


def plan_at(person: Person, world: World, x: float, y: float, heading: float) -> Plan:
    plan = Plan(person, np.array([x, y, 0.0]), heading, world.floor_height)
    plan.time = 0.4
    return plan


def performed(plan: Plan, world: World, rng: np.random.Generator) -> SimulatedMotion:
    """The plan's motion and half a second more."""
    duration = plan.time + 0.5
    plan.time = duration + 2.0
    return perform(plan, world, rng, duration, FPS)


def palm_errors(plan: Plan, motion: Motion) -> torch.Tensor:
    """Distances (m) of palms from where their grips want them, while they hold."""
    times, chest = motion.timestamps.numpy(), motion.joint("t8").to(torch.float64)
    found = []
    for side in SIDES:
        palm = site_positions(motion.skeleton, motion.T_world_joint, (f"{side}_palm",))[:, 0].double()
        for grip in plan.grips[side]:
            part = torch.from_numpy((times >= grip.touch_s) & (times <= grip.release_s))
            hold = grip.hold(times[part.numpy()], chest[part])
            found.append((palm[part] - hold.palm).norm(dim=-1))
    return torch.cat(found)


def assert_natural(simulated: SimulatedMotion) -> None:
    """Nothing jumps, feet neither slide nor sink, elbows and wrists keep to their ranges."""
    motion = simulated.motion
    skeleton, position = motion.skeleton, motion.T_world_joint.t.double()
    acceleration = (position.diff(n=2, dim=0) * FPS**2).norm(dim=-1)
    jerk = (position.diff(n=3, dim=0) * FPS**3).norm(dim=-1)
    for name, limit, jerk_limit in (("pelvis", 25, 1500), ("head", 30, 2500), ("left_wrist", 60, 2500)):
        assert acceleration[:, skeleton.index(name)].max() < limit, name
        assert jerk[:, skeleton.index(name)].max() < jerk_limit, name
    feet = site_positions(skeleton, motion.T_world_joint, FOOT_PATCHES).double()
    speed = feet[..., :2].diff(dim=0).norm(dim=-1) * FPS
    still = simulated.contact[1:] & simulated.contact[:-1]
    assert speed[still].max() < 0.02
    assert feet[..., 2].min() > -0.005
    for side in SIDES:
        elbow, wrist = (
            motion.R_parent_joint[:, skeleton.index(f"{side}_{joint}")].double() for joint in ("elbow", "wrist")
        )
        axis = torch.tensor([0.0, 1.0 if side == "left" else -1.0, 0.0], dtype=torch.float64)
        forearm = elbow @ axis
        bend = torch.atan2(forearm[:, 0], forearm @ axis)
        hinge = torch.tensor([0.0, 0.0, -1.0 if side == "left" else 1.0], dtype=torch.float64)
        turn, rest = forearm_and_wrist(rotation.exp(bend[:, None] * hinge), elbow, axis)
        assert rest.norm(dim=-1).max() < 0.02, "a hinge, and the forearm's turn"
        assert bend.min() > -0.02
        assert bend.rad2deg().max() < 151
        assert turn.abs().rad2deg().max() < 95
        assert rotation.log(wrist)[:, 0].abs().rad2deg().max() < 80
        assert rotation.log(wrist)[:, 2].abs().rad2deg().max() < 40
