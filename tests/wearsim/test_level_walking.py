"""Simulated wearers walk over level ground as healthy adults do, at slow, usual and fast speeds."""

from functools import cache

import numpy as np
import pytest
import torch
from handled import FPS, level_world, performed, plan_at

from wearcap.body.kinematics import site_positions
from wearcap.metrics.gait import STANCE, knee_cycles, knee_deg, normal_knee_deg, standing
from wearcap.recording.motion import Motion
from wearsim.people.person import draw_person
from wearsim.people.walking import walk_along

SPEEDS = (0.8, 1.1, 1.3, 1.6)
PEOPLE = range(1, 7)


@cache
def walks(speed: float) -> tuple[Motion, ...]:
    """Some people who stand for 2 s, walk 10 m straight on and stop."""
    floor, made = level_world(), []
    for seed in PEOPLE:
        rng = np.random.default_rng(seed)
        plan = plan_at(draw_person("p", rng), floor, -5.0, 0.0, 0.0)
        plan.time = 2.0
        walk_along(plan, np.array([[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), rng, speed)
        made.append(performed(plan, floor, rng).motion)
    return tuple(made)


def steady(motion: Motion) -> slice:
    """2 s in the middle of the way."""
    middle = int((motion.t_world_root[:, 0] > 0.0).nonzero()[0])
    return slice(middle - round(FPS), middle + round(FPS))


def curves(speed: float) -> torch.Tensor:
    """Each person's mean flexion (degrees), person point."""
    return torch.stack([torch.cat(knee_cycles(motion)).mean(0) for motion in walks(speed)])


@pytest.mark.parametrize("speed", SPEEDS)
def test_knees_follow_the_normal_curve(speed):
    off = (curves(speed) - normal_knee_deg()).square().mean(1).sqrt()
    assert off.median() < 6
    assert off.max() < 9
    assert (curves(speed).mean(0) - normal_knee_deg()).square().mean().sqrt() < 6
    stance = curves(speed)[:, STANCE].median(1).values
    assert stance.min() > 4
    assert stance.max() < 18


def test_the_knee_yields_more_to_the_load_of_faster_steps():
    yields = [curves(speed)[:, 35:50].amax(1).mean().item() for speed in SPEEDS]
    assert sorted(yields) == yields
    assert 9 < yields[0] < yields[-1] < 22


@pytest.mark.parametrize("speed", SPEEDS)
def test_the_pelvis_rises_and_falls_over_knees_that_never_lock(speed):
    rises = []
    for motion in walks(speed):
        z = motion.t_world_root[steady(motion), 2]
        rises.append(100 * (z.max() - z.min()).item())
        assert knee_deg(motion).min() > 3
    assert 1.8 < np.mean(rises) < 6


def test_people_who_stand_have_nearly_straight_knees():
    for motion in walks(1.3):
        knees = knee_deg(motion)[standing(motion)]
        assert len(knees) > FPS
        assert 2 < knees.mean() < 7.5


@pytest.mark.parametrize("speed", SPEEDS)
def test_toes_clear_the_floor(speed):
    for motion in walks(speed):
        part = motion.sliced(steady(motion).start, steady(motion).stop)
        for side in ("left", "right"):
            tip = site_positions(part.skeleton, part.T_world_joint, (f"{side}_toe_tip",))[:, 0]
            speed_x, height = (tip[2:] - tip[:-2])[:, 0] * FPS / 2, tip[1:-1, 2]
            least = (height[1:-1] < height[:-2]) & (height[1:-1] < height[2:]) & (speed_x[1:-1] > 1.5)
            assert least.any(), "lowest in the middle of the swing, as people's are"
            assert 0.01 < height[1:-1][least].min() < 0.03
            assert height[speed_x > 2.0].min() > 0.007
