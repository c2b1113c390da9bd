"""Errors of simulated sensors are measured as they were planted."""

import numpy as np
import pytest
import torch

from benchmarks.tables import simulated_sensors
from benchmarks.tables import simulated_sensors as measured
from benchmarks.tables import simulation as tables_simulation
from wearcap.sensors.imu import ImuNoise
from wearcap.sensors.simulated import SlamNoise
from wearsim.recordings.hps import HpsConfig, Protocol
from wearsim.recordings.localization_noise import LocalizationNoise, MapErrors
from wearsim.sensors.suit import BodyErrors, ContactErrors, PathErrors, SegmentErrors, SuitNoise

SEGMENTS = SegmentErrors(fixed_deg=0.0, slow_deg=0.0, soft_tissue_deg=0.0)
PATH = PathErrors(0.0, 0.0, 0.0, scale=0.0, step_scale=0.0, height_m=0.0, height_drift_m=0.0)
PERFECT = SuitNoise(SEGMENTS, PATH, BodyErrors(0.0, 0.0), ContactErrors((0.0, 0.0), (0.0, 0.0)))


@pytest.fixture(scope="module")
def walked():
    """A short session of the simulator."""
    return simulated_sensors.session(0, HpsConfig(protocol=Protocol(returns_m=(15.0,), end_m=20.0)))


def test_a_perfect_suit_has_no_errors(walked):
    found = measured.suit_errors(walked, PERFECT, (15.0,), np.random.default_rng(0))
    assert set(found) >= {"heading_deg_per_sqrt_min", "bone_percent", "off_after_15_m_cm", "contact_late_ms"}
    assert {name: value for name, value in found.items() if abs(value) > 0.1} == {}


def test_a_suits_planted_errors_are_found_apart(walked):
    path = PathErrors(6.0, 0.0, 0.0, scale=0.01, step_scale=0.0, height_m=0.0, height_drift_m=0.0)
    noise = SuitNoise(SEGMENTS, path, BodyErrors(0.0, 0.02), ContactErrors((0.05, 0.05), (0.0, 0.0)))
    draws = [measured.suit_errors(walked, noise, (15.0,), np.random.default_rng(k)) for k in range(16)]
    found = measured.reduced(draws)
    assert found["heading_deg_per_sqrt_min"]["mean"] == pytest.approx(6.0, rel=0.4)
    assert found["length_percent"]["mean"] == pytest.approx(1.0, rel=0.4)
    assert found["stature_cm"]["mean"] == pytest.approx(2.0, rel=0.5)
    assert found["contact_late_ms"]["mean"] == pytest.approx(50.0, abs=1.0)
    assert found["contact_wrong_percent"]["mean"] < 0.1
    assert found["segment_deg"]["mean"] < 0.1  # the heading's error is no error of segments
    assert found["off_after_15_m_cm"]["std"] is not None


def test_localisation_and_map_are_found_apart(walked):
    flat = MapErrors((1.0, 1.0), (0.004, 0.004), (0.0, 0.0))
    noise = LocalizationNoise(
        (0.05, 0.05), (1.0, 1.0), outliers=(0.1, 0.1), outlier_m=(1.0, 5.0), lost=(0.0, 0.0), map=flat
    )
    found = measured.localization_errors(walked, noise, np.random.default_rng(0))
    assert found["outlier_percent"] == pytest.approx(10.0, abs=2.0)
    assert found["lost_percent"] == found["longest_outage_s"] == 0
    assert found["position_cm"] == pytest.approx(5.0, rel=0.4)
    assert found["tilt_deg"] == pytest.approx(1.0, abs=0.01)
    assert found["scale_percent"] == pytest.approx(0.4, abs=0.01)
    assert found["bend_cm"] < 0.01


def test_a_watch_and_a_head_tracker(walked):
    motion = walked.motion.motion
    alone = ImuNoise(0.0, 0.0, acc_noise=0.04, acc_bias=0.0, gyro_noise_deg_s=0.3, strap_deg=0.0)
    found = measured.watch_errors(motion, alone, np.random.default_rng(0))
    assert found["noise_ug_per_sqrt_hz"] == pytest.approx(1e6 * 0.04 / 9.81 / (motion.fps / 2) ** 0.5, rel=0.02)
    assert found["bias_mg"] < 0.1
    assert max(found["attitude_deg"], abs(found["heading_after_10_min_deg"]), found["strap_deg"]) < 0.1
    head = measured.head_errors(motion, SlamNoise(0.002, 0.1), np.random.default_rng(0))
    assert head["head_cm"] == pytest.approx(0.2 * 3**0.5, rel=0.15)
    assert head["jitter_deg"] == pytest.approx(0.1, rel=0.15)


def test_flags_that_are_late_are_not_wrong():
    true = torch.rand(600, 4, generator=torch.Generator().manual_seed(0)) > 0.5
    late = torch.cat([true[:1].expand(3, -1), true[:-3]])
    assert measured.flag_errors(late.float(), true, 60.0) == (pytest.approx(0.05), 0.0)


def test_a_reach_of_minimum_jerk():
    t = np.linspace(0, 1, 200)
    found = measured.movement(np.concatenate([np.zeros(50), 30 * t**2 * (1 - t) ** 2, np.zeros(50)]), 200.0)
    assert found is not None
    assert found == (pytest.approx(0.88, abs=0.02), pytest.approx(1.66, abs=0.01))
    assert measured.movement(np.linspace(1, 0, 50), 200.0) is None


def test_every_literature_figure_has_a_source():
    rows = tables_simulation._literature()
    assert len({row[0] for row in rows}) == len(rows)
    assert all(len(row) == 5 and all(row) for row in rows)
    assert set(tables_simulation.KEY) <= {row[0] for row in rows}
    assert all(source == "ours" for _, _, _, published, source in rows if published == "–")
