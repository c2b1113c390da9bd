"""The knee over the gait cycle: found at its true angle and phase, and only where people walk straight on level ground."""

import math
from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import POINTS, STANCE, knee_cycles, knee_deg, normal_knee_deg, standing, cycle_times
from wearcap.metrics.table import Row, aggregate, both_walking
from wearcap.recording.motion import Motion


def walk(
    bend_deg: float = 0.0, speed: float = 1.2, seconds: float = 8.0, fps: float = 60, climb: float = 0.0
) -> Motion:
    """A body that glides along x, its knees following the normal curve plus a constant bend, 1.1 s a cycle."""
    times = torch.arange(round(seconds * fps), dtype=torch.float64) / fps
    R = torch.eye(3).repeat(len(times), 23, 1, 1)
    skeleton = xsens23()
    for k, side in enumerate(("left", "right")):
        share = ((times / 1.1 + 0.5 * k) % 1.0) * (POINTS - 1)
        low = share.long().clamp(max=POINTS - 2)
        curve = normal_knee_deg().double()
        flexion = curve[low] + (share - low) * (curve[low + 1] - curve[low]) + bend_deg
        R[:, skeleton.index(f"{side}_knee")] = about_axis("y", flexion.deg2rad().float())
    t = torch.stack([speed * times, 0 * times, 0.9 + climb * times], -1).float()
    return Motion(times, skeleton, R, t)


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


def test_a_captures_knees_are_read_over_the_truths_cycles():
    """Also of a capture in which nobody would find a walk: stiff legs that glide."""
    truth = walk(6.0)
    stiff = replace(truth, R_parent_joint=torch.eye(3).expand_as(truth.R_parent_joint))
    stance = normal_knee_deg()[STANCE].mean().item()
    found = both_walking(walk(20.0), truth)
    assert found["stance_knee_deg"] == pytest.approx(stance + 20, abs=0.5)
    assert found["truth_stance_knee_deg"] == pytest.approx(stance + 6, abs=0.5)
    assert found["knee_curve_rms_deg"] == pytest.approx(20, abs=0.5)
    assert found["truth_knee_curve_rms_deg"] == pytest.approx(6, abs=0.5)
    found = both_walking(stiff, truth)
    assert found["stance_knee_deg"] == pytest.approx(0, abs=0.1)
    assert found["knee_curve_rms_deg"] == pytest.approx(normal_knee_deg().square().mean().sqrt().item(), abs=0.1)
    assert both_walking(truth, stiff) == {}


def test_the_median_cycle_counts():
    """A wearer who crouches after 4.4 s of 8 is judged by the longer part."""
    upright, bent = walk(), walk(30.0)
    late = upright.timestamps[:, None, None, None] > 4.4
    both = replace(upright, R_parent_joint=torch.where(late, bent.R_parent_joint, upright.R_parent_joint))
    left = cycle_times(upright)[0]
    assert ((left[1:, 0] - left[:-1, 1]).abs() < 0.02).all()
    assert (left[:, 1] - left[:, 0] - 1.1).abs().max() < 0.04
    stance = normal_knee_deg()[STANCE].mean().item()
    assert both_walking(both, upright)["stance_knee_deg"] == pytest.approx(stance, abs=1)


def test_walks_count_alike_and_others_not():
    knees = [(900, 10.0), (100, 30.0), (5000, None)]
    names = ("stance_knee_deg", "truth_stance_knee_deg")
    rows = [
        Row(str(k), 0, n, {"mpjpe_cm": 1.0 + k, **({} if v is None else dict.fromkeys(names, v))})
        for k, (n, v) in enumerate(knees)
    ]
    found = aggregate(rows)
    assert found["stance_knee_deg"].mean == found["truth_stance_knee_deg"].mean == 20
    assert found["mpjpe_cm"].mean == pytest.approx((900 + 200 + 15000) / 6000)
    assert "stance_knee_deg" not in aggregate(rows[2:])
