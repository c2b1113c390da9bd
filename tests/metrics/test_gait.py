"""The knee over the gait cycle: found at its true angle and phase, and only where people walk straight on level ground."""

import math
from dataclasses import replace

import pytest
import torch

from normal_walk import walk
from wearcap.body.skeleton import xsens23
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import STANCE, knee_cycles, knee_deg, normal_knee_deg, standing
from wearcap.recording.motion import Motion


def test_the_normal_curve_peaks_in_swing_and_straightens_in_stance():
    curve = normal_knee_deg()
    assert curve[0] == curve[-1] == curve.max() == 62
    assert curve[STANCE].mean() == pytest.approx(11.5, abs=1.0)


@pytest.mark.parametrize("bend", [0.0, 12.0])
def test_cycles_repeat_the_knee_that_was_walked(bend):
    left, right = knee_cycles(walk(bend))
    assert len(left) >= 5
    assert len(right) >= 5
    for cycles in (left, right):
        assert (cycles.mean(0) - normal_knee_deg() - bend).abs().max() < 1.5


@pytest.mark.parametrize("changes", [{"speed": 0.1}, {"speed": 3.0}, {"climb": 0.3}])
def test_running_treading_on_the_spot_and_climbing_are_not_walks(changes):
    assert all(len(cycles) == 0 for cycles in knee_cycles(walk(**changes)))


def test_a_turn_is_not_straight():
    motion = walk()
    angle = 2.5 * motion.timestamps
    circle = torch.stack([0.5 * angle.cos(), 0.5 * angle.sin(), 0 * angle + 0.9], -1).float()
    assert all(len(cycles) == 0 for cycles in knee_cycles(replace(motion, t_world_root=circle)))


def test_standing_is_upright_still_and_on_both_feet():
    skeleton, times = xsens23(), torch.arange(60, dtype=torch.float64) / 30
    R, t = torch.eye(3).repeat(60, 23, 1, 1), torch.zeros(60, 3)
    still = Motion(times, skeleton, R, t)
    assert standing(still)[1:-1].all()
    assert knee_deg(still).max() < 0.1
    assert not standing(replace(still, t_world_root=0.5 * times[:, None].float().expand(60, 3))).any()
    bowed = R.clone()
    bowed[:, 0] = about_axis("y", torch.tensor(math.radians(60)))
    assert not standing(replace(still, R_parent_joint=bowed)).any()
    lifted = R.clone()
    lifted[:, skeleton.index("left_hip")] = about_axis("y", torch.tensor(math.radians(-60)))
    assert not standing(replace(still, R_parent_joint=lifted)).any()
