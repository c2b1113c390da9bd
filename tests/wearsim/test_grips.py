"""Gripping hands follow their objects, however these move."""

import numpy as np
import pytest
import torch
from handled import assert_natural, level_world, palm_errors, performed, plan_at

from wearsim.handling.grips import Grip, GripPlace, still
from wearsim.people.person import draw_person
from wearsim.places.movables import floor_pose

UP = GripPlace((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def floor():
    return level_world()


def wandering(aside):
    """A point that sways before a stander, at times out of an arm's reach."""

    def moves(times, chest):
        x, turn = 0.55 + 0.15 * np.sin(times), 0.3 * np.sin(0.5 * times)
        return floor_pose(np.stack([x, aside + 0 * x, turn], 1), 0.8 + 0.2 * np.sin(0.7 * times))

    return moves


@pytest.mark.parametrize("seed", [0, 1])
def test_palms_stay_on_what_moves_with_the_trunks_help(floor, seed):
    rng = np.random.default_rng(seed)
    person = draw_person("p", rng)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    for side, aside in (("left", 0.2), ("right", -0.2)):
        plan.grip(side, Grip.drawn(UP, wandering(aside), 1.5, 8.0, rng, 1.0))
    plan.time = 9.0
    simulated = performed(plan, floor, rng)
    assert palm_errors(plan, simulated.motion).max() < 0.002
    assert_natural(simulated)


def test_the_palm_faces_the_surface_and_the_hand_comes_from_off_it(floor, person):
    rng = np.random.default_rng(3)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    pose = floor_pose(np.array([0.45, 0.2, 0.0]), 0.95)
    plan.grip("left", Grip(UP, still(pose), 1.5, 3.0))
    plan.time = 4.0
    motion = performed(plan, floor, rng).motion
    held = (motion.timestamps > 1.5) & (motion.timestamps < 3.0)
    R = motion.joint("left_wrist").R[held].double()
    assert (R[:, :, 2] - torch.tensor([0.0, 0.0, 1.0])).norm(dim=-1).max() < 1e-4
    ahead = torch.rad2deg(torch.atan2(R[:, 1, 1], R[:, 0, 1]))
    assert ahead.abs().max() < 41, "fingers about as wished"
    wrist = motion.joint("left_wrist").t
    near = (motion.timestamps > 1.3) & (motion.timestamps < 1.42)
    assert wrist[near, 2].min() > wrist[held, 2].max() + 0.002, "it comes down on it"


def test_one_thing_after_the_other(floor, person):
    rng = np.random.default_rng(4)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    for x, touch in ((0.35, 1.5), (0.5, 2.6)):
        plan.grip("right", Grip(UP, still(floor_pose(np.array([x, -0.2, 0.3]), 1.0)), touch, touch + 0.5, 0.6))
    with pytest.raises(ValueError, match="holds another"):
        plan.grip("right", Grip(UP, still(floor_pose(np.zeros(3))), 3.2, 4.0))
    plan.time = 4.0
    simulated = performed(plan, floor, rng)
    assert palm_errors(plan, simulated.motion).max() < 0.002
    assert_natural(simulated)
