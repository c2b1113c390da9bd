"""Two clocks from common claps: planted offset and drift come back; missing, extra and ambiguous claps."""

import numpy as np
import pytest
import torch
from test_claps import arms

from wearcap.errors import WearcapError
from wearcap.recording import Localization, Recording
from wearcap.sensors.claps import detect_claps
from wearcap.sensors.clock import fit_clock, retime


def times(values):
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)


def groups(starts, rng, claps=3):
    """Three claps at human intervals at each start."""
    return np.concatenate([start + rng.uniform(0.35, 0.6, claps).cumsum() for start in starts])


def gained(suit, offset, drift_s_per_hour):
    return suit + offset + drift_s_per_hour * suit / 3600


@pytest.mark.parametrize("rate", [60.0, 120.0, 240.0])
def test_planted_clock_is_recovered_from_spikes(rate):
    """Offset within 2 ms everywhere, drift within 5 ms/h, at thirteen groups of claps in an hour."""
    rng = np.random.default_rng(3)
    starts = 20 + 300.0 * np.arange(12)
    suit = groups(starts, rng)
    camera = gained(suit, 41.237, 0.087) + 0.0005 * rng.standard_normal(len(suit))
    found = []
    for number, start in enumerate(starts):  # the hour around the claps is left out
        pair = arms(10.0, rate, suit[(suit > start) & (suit < start + 5)] - start + 3.0, seed=number)
        found.append(detect_claps(*pair) + start - 3.0)
    clock = fit_clock(times(camera), torch.cat(found))
    assert clock.claps == 36
    assert clock.drift_s_per_hour == pytest.approx(0.087, abs=0.005)
    assert clock.offset_s == pytest.approx(41.237 + 0.087 * clock.suit_s[0].item() / 3600, abs=0.002)
    at = times(np.linspace(0, 3700, 500))
    truth = gained(at, 41.237, 0.087)
    assert (clock.to_camera(at) - truth).abs().max() < 0.002
    torch.testing.assert_close(clock.to_suit(clock.to_camera(at)), at, atol=1e-9, rtol=0)
    assert clock.residual_s < 0.003


def test_one_clap_gives_the_offset_alone():
    clock = fit_clock(times([312.5]), times([12.0]))
    assert (clock.offset_s, clock.drift_s_per_hour, clock.claps) == (300.5, 0.0, 1)
    assert clock.to_camera(times([0.0, 12.0, 99.0])).tolist() == [300.5, 312.5, 399.5]
    assert clock.to_suit(times([300.5])).tolist() == [0.0]


def test_between_claps_the_clock_bends_and_beyond_them_it_keeps_the_mean_drift():
    suit = np.array([0.0, 1000.0, 3000.0])
    camera = suit + 5 + np.array([0.0, 0.02, 0.03])
    clock = fit_clock(times(camera), times(suit))
    torch.testing.assert_close(clock.to_camera(times(suit)), times(camera), atol=1e-9, rtol=0)
    assert clock.to_camera(times([500.0])).item() == pytest.approx(505.01)
    beyond = clock.to_camera(times([4000.0])).item() - camera[2] - 1000
    assert beyond == pytest.approx(1000 * clock.drift_s_per_hour / 3600)
    assert 0.005 < beyond < 0.02


@pytest.mark.parametrize("seed", range(10))
def test_missing_and_extra_claps_do_no_harm(seed):
    rng = np.random.default_rng(seed)
    suit = groups([10.0, 620.0, 1300.0, 3400.0], rng)
    offset, drift = rng.uniform(-300, 300), rng.uniform(-0.18, 0.18)
    camera = gained(suit, offset, drift) + 0.001 * rng.standard_normal(len(suit))
    worn = np.concatenate([suit[rng.uniform(size=len(suit)) > 0.25], rng.uniform(0, 3500, 8)])
    seen = np.concatenate([camera[rng.uniform(size=len(suit)) > 0.25], rng.uniform(0, 3500, 8) + offset])
    clock = fit_clock(times(rng.permutation(seen)), times(rng.permutation(worn)))
    at = times(np.linspace(0, 3600, 100))
    assert (clock.to_camera(at) - gained(at, offset, drift)).abs().max() < 0.006
    assert clock.claps >= 4


def test_two_claps_close_together_say_little_of_drift():
    """A millisecond's noise over a minute would be 60 ms an hour."""
    clock = fit_clock(times([10.0, 70.002]), times([0.0, 60.0]))
    assert abs(clock.drift_s_per_hour) < 0.03


def test_what_cannot_be_decided_is_refused():
    with pytest.raises(WearcapError, match="no clap found by the camera"):
        fit_clock(times([]), times([1.0]))
    with pytest.raises(WearcapError, match="no clap found by the suit"):
        fit_clock(times([1.0]), times([]))
    with pytest.raises(WearcapError, match="less than 600 s"):
        fit_clock(times([1.7e9]), times([3.0]))
    with pytest.raises(WearcapError, match="several ways"):
        fit_clock(times([10.0, 11.0, 12.0]), times([20.0, 21.0]))
    early = fit_clock(times([12.0, 12.9, 14.1]), times([10.0, 10.9, 12.1, 310.0, 310.9, 312.1]))
    assert abs(early.offset_s - 2.0) < 1e-6  # not 298 s before: the camera stopped early
    assert fit_clock(times([1.7e9]), times([3.0]), max_offset_s=float("inf")).offset_s == 1.7e9 - 3


def test_camera_and_localization_move_to_the_suits_clock():
    clock = fit_clock(times([15.0]), times([5.0]))
    found = Localization(times([10.0, 11.0]), torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3), torch.ones(2))
    moved = retime(Recording("walk", localization=found), clock)
    assert moved.localization.timestamps.tolist() == [0.0, 1.0]
    assert moved.camera is None
