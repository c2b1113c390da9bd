"""Poses of handling in which nothing of the environment is touched."""

import numpy as np
import pytest
import torch

from wearcap.body.kinematics import site_positions
from wearcap.simulation.handling.household import USUAL, Household
from wearcap.simulation.handling.imitating import imitate
from wearcap.simulation.people.plan import SIDES
from wearcap.simulation.people.wearer import TAIL_S, perform
from wearcap.simulation.places.interactive_flat import House
from wearcap.simulation.recordings.interaction_session import flat_of

FPS = 30.0


@pytest.mark.parametrize("category", ["door", "chair", "box", "drawer"])
def test_what_is_imitated_touches_and_moves_nothing(person, category):
    rng, flat = np.random.default_rng(3), flat_of("val", 1)
    house = House(flat)
    household = Household(house, person, rng)
    plan, values, poses = household.plan, dict(house.values), dict(house.poses)
    items = [item for item in (*flat.movables, *flat.openables) if item.category == category]
    assert any(imitate(plan, house, rng, item, 1.0) for item in items * 3)
    assert not house.handlings
    assert (house.values, house.poses) == (values, poses)
    stop = plan.time + 0.3
    plan.time = stop + TAIL_S
    motion = perform(plan, flat.static, rng, stop, FPS).motion
    palms = site_positions(motion.skeleton, motion.T_world_joint, ("left_palm", "right_palm"))
    grips = [(palm, grip) for side, palm in zip(SIDES, palms.unbind(1)) for grip in plan.grips[side]]
    assert grips
    for palm, grip in grips:
        frames = torch.linspace(grip.touch_s * FPS, grip.release_s * FPS - 1, 6).long()
        assert flat.environment.nearest(palm[frames]).distance.min() > 0.02


def test_hands_that_touch_nothing_are_as_often_in_the_poses_of_touching(person):
    held = alike = 0.0
    for number in range(2):
        household = Household(House(flat_of("val", number)), person, np.random.default_rng(number), USUAL)
        household.live(60.0)
        for handling in household.house.handlings:
            held += sum((stop - start) * sum(hands) for start, stop, hands in handling.rows)
        alike += household.alike_s.total()
    assert held > 10.0
    assert 0.4 < alike / held < 1.6
