"""Small steps follow any path of the body."""

import numpy as np
import pytest
from handled import assert_natural, level_world, performed, plan_at

from wearsim.people.person import draw_person
from wearsim.people.plan import SIDES
from wearsim.people.track import ease
from wearsim.people.walking import shuffle, step_to


@pytest.fixture(scope="module")
def floor():
    return level_world()


@pytest.mark.parametrize(
    ("change", "seconds"),
    [((1.6, 0.0, 0.0), 6.0), ((-1.2, 0.0, 0.0), 6.0), ((0.0, 1.0, 0.0), 6.0), ((0.5, -0.6, 1.4), 6.0)],
)
def test_feet_follow_and_end_together(floor, change, seconds):
    rng = np.random.default_rng(5)
    person = draw_person("p", rng)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    body = lambda times: ease((times - 1.0) / seconds)[:, None] * np.array(change)  # noqa: E731
    shuffle(plan, rng, body, 1.0, 1.0 + seconds)
    assert np.abs(plan.position[:2] - change[:2]).max() < 0.05
    assert plan.heading == pytest.approx(change[2], abs=0.06)
    assert plan.time < 1.0 + seconds + 1.0
    left, right = (plan.prints[side] for side in SIDES)
    landings = np.sort([print_.land_s for print_ in (*left[1:], *right[1:])])
    assert np.diff(landings).min() > 0.3
    simulated = performed(plan, floor, rng)
    assert_natural(simulated)
    wanted = body(simulated.motion.timestamps.numpy())
    away = np.linalg.norm(simulated.motion.t_world_root[:, :2].numpy() - wanted[:, :2], axis=1)
    assert away.max() < 0.16


def test_what_does_not_move_takes_no_step(floor, person):
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    shuffle(plan, np.random.default_rng(0), lambda times: np.zeros((len(times), 3)), 1.0, 3.0)
    assert [len(plan.prints[side]) for side in SIDES] == [1, 1]
    assert plan.time == 3.0


def test_stepping_to_a_place_nearby(floor, person):
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    step_to(plan, np.random.default_rng(1), np.array([-0.3, 0.2]), 2.0)
    assert np.abs(plan.position[:2] - [-0.3, 0.2]).max() < 0.05
    assert plan.heading == pytest.approx(2.0, abs=0.06)
