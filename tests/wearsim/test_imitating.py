"""Poses of handling in which nothing of the environment is touched."""

import numpy as np
import pytest
import torch

from wearcap.body.kinematics import site_positions
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis
from wearsim.handling.grips import Grip, GripPlace, still
from wearsim.handling.household import USUAL, Household
from wearsim.handling.imitating import MIMED, STILL, imitate, loosened
from wearsim.people.plan import SIDES
from wearsim.people.wearer import TAIL_S, perform
from wearsim.places.interactive_flat import House
from wearsim.recordings.interaction_session import flat_of

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


def test_nothing_guides_hands_that_touch_nothing():
    """Hands held out keep to the chest; others stray from the path of a touch; few go as if they touched."""
    rng, times = np.random.default_rng(0), np.linspace(0.0, 6.0, 361)
    sway = np.stack([0.3 * np.sin(times), 0.2 * np.cos(times), 0.0 * times], 1)
    chest = Rigid(about_axis("z", torch.from_numpy(0.5 * np.sin(times))), torch.from_numpy(sway))
    place = Rigid(torch.eye(3), torch.tensor([0.5, 0.2, 1.0]))
    grip = Grip(GripPlace((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), still(place), 1.0, 5.0)
    far, still_s = [], []
    for manner in rng.random(200):
        palm = loosened(grip, rng, manner).hold(times, chest).palm
        far.append(float((palm - grip.hold(times, chest).palm)[60:300].norm(dim=-1).mean()))
        if MIMED < manner < MIMED + STILL:
            local = (chest.R.mT @ (palm - chest.t)[..., None])[60:300, :, 0]
            still_s.append(float((local - local.mean(0)).norm(dim=-1).max()))
    assert max(still_s) < 0.15
    assert np.mean(np.array(far) < 0.02) < 0.1


def test_hands_that_touch_nothing_are_as_often_in_the_poses_of_touching(person):
    held = alike = 0.0
    for number in range(2):
        household = Household(House(flat_of("val", number)), person, np.random.default_rng(number), USUAL)
        household.live(60.0)
        for handling in household.house.handlings:
            held += sum((stop - start) * sum(hands) for start, stop, hands in handling.rows)
        alike += household.alike_s.total()
    assert held > 10.0
    assert 0.6 < alike / held < 2.0
