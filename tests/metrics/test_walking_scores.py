"""Scores of walking: read over the truth's cycles, missing where nobody walks, every walk counting alike."""

from dataclasses import replace

import pytest
import torch

from normal_walk import walk
from wearcap.metrics.gait import STANCE, cycle_times, normal_knee_deg
from wearcap.metrics.table import Row, aggregate, both_walking


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
    assert ((left[1:, 0] - left[:-1, -1]).abs() < 0.02).all()
    assert (left[:, -1] - left[:, 0] - 1.1).abs().max() < 0.04
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
