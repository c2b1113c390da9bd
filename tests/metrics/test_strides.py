"""Strides read off a person who walks round a circle with planted feet, whose steps are known, and off a limping one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from walking_person import CYCLE, RADIUS, SPEED, STANCE, walk
from wearcap.metrics.strides import gait_report, strides

SECONDS, FPS = 12.0, 120.0
BEFORE = (0.5 - (0.25 - (1 - STANCE) / 6) ** 0.5) * (1 - STANCE) * CYCLE
"""Root of d/ds (3 s² − 2 s³) = 1 − STANCE, from the end of the swing (s)."""


@pytest.fixture(scope="module")
def walked():
    motion, contact = walk(torch.arange(int(SECONDS * FPS), dtype=torch.float64) / FPS)
    return replace(motion, contact_prob=contact.float())


def test_strides_are_those_that_were_walked(walked):
    left, right = strides(walked)
    assert (len(left), len(right)) == (9, 9)
    for side, radius in ((left, RADIUS - 0.085), (right, RADIUS + 0.085)):
        chord = 2 * radius * math.sin(SPEED * CYCLE / RADIUS / 2)
        for stride in side:
            assert stride.stride_length_m == pytest.approx(chord, abs=0.01)
            assert stride.stride_time_s == pytest.approx(CYCLE, abs=1.5 / FPS)
            assert stride.step_time_s == pytest.approx(CYCLE / 2, abs=1.5 / FPS)
            # Such a foot is farthest ahead, and behind, when it is as fast as the body, 31 ms before it is set down.
            assert stride.stance_time_s == pytest.approx(STANCE * CYCLE + 2 * BEFORE, abs=2.5 / FPS)
            assert stride.swing_time_s == pytest.approx((1 - STANCE) * CYCLE - 2 * BEFORE, abs=2.5 / FPS)
            assert stride.cadence_per_min == pytest.approx(120 / CYCLE, abs=1)
            assert stride.speed_m_s == pytest.approx(chord / CYCLE, abs=0.02)
            assert stride.step_length_m == pytest.approx(chord / 2, abs=0.03)
    # The chord of a stride cuts the circle: the other foot is 17 cm plus or less the sagitta from it.
    sagitta = RADIUS * (1 - math.cos(SPEED * CYCLE / RADIUS / 2))
    widths = [np.mean([stride.step_width_m for stride in side]) for side in (left, right)]
    assert widths == pytest.approx([0.17 + sagitta, 0.17 - sagitta], abs=0.01)


def test_contacts_of_the_feet_s_speed_give_the_same(walked):
    own, found = gait_report(walked), gait_report(replace(walked, contact_prob=None))
    assert own is not None
    assert found is not None
    for name in ("stride_length_m", "step_width_m", "stride_time_s"):
        assert found["left"][name]["mean"] == pytest.approx(own["left"][name]["mean"], rel=0.05)


def test_a_limp_is_an_asymmetry(walked):
    """Time is warped so that every right strike comes 0.1 s late."""
    late = 0.05 * (1 - (2 * math.pi * walked.timestamps / CYCLE).cos())
    report = gait_report(replace(walked, timestamps=walked.timestamps + late))
    assert report is not None
    assert report["asymmetry_percent"]["step_time_s"] == pytest.approx(200 * -0.2 / CYCLE, abs=2)
    assert report["asymmetry_percent"]["step_length_m"] == pytest.approx(
        gait_report(walked)["asymmetry_percent"]["step_length_m"]
    )
    assert report["right"]["stance_percent"]["std"] < 1


def test_who_goes_backwards_or_stands_has_no_strides(walked):
    turned = walked.R_parent_joint.clone()
    turned[:, 0] = turned[:, 0] @ torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    assert gait_report(replace(walked, R_parent_joint=turned)) is None
    assert gait_report(replace(walked, contact_prob=torch.ones_like(walked.contact_prob))) is None
