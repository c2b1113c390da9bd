"""Channels, filters and the pendulum that the wearer is made of."""

import numpy as np
import pytest

from wearsim.people.track import Track, ease, hermite, lower_envelope, pendulum, wander


def test_overlapping_transitions_add_up():
    track = Track(np.zeros(1))
    track.move(1.0, 2.0, 1.0)
    track.move(1.5, 3.0, 0.5)
    times = np.linspace(0.0, 4.0, 401)
    value = track.sample(times)[:, 0]
    assert (value[times <= 1.0] == 0).all()
    assert value[-1] == pytest.approx(0.5)
    assert track.last[0] == 0.5
    assert value[150] == pytest.approx(0.5), "half way through the first, at the start of the second"


def test_minimum_jerk_peaks_at_one_and_seven_eighths_of_the_mean_speed():
    share = np.linspace(0.0, 1.0, 10_001)
    assert np.gradient(ease(share), share).max() == pytest.approx(1.875, abs=1e-3)
    np.testing.assert_array_equal(ease(np.array([-1.0, 0.0, 1.0, 2.0])), [0, 0, 1, 1])


def test_hermite_meets_values_and_slopes():
    share = np.linspace(0.0, 1.0, 10_001)
    one = np.ones_like(share)
    curve = hermite(share, (2 * one, -1 * one), (3 * one, 0.5 * one))
    slope = np.gradient(curve, share)
    np.testing.assert_allclose([curve[0], curve[-1], slope[0], slope[-1]], [2, -1, 3, 0.5], atol=1e-3)


def test_the_envelope_is_smooth_and_never_above():
    bumpy = np.sin(np.arange(300) / 9.0) + 0.3 * np.sin(np.arange(300) / 2.0)
    envelope = lower_envelope(bumpy, 0.1, 60.0)
    assert (envelope <= bumpy + 1e-12).all()
    assert np.abs(np.diff(envelope, 2)).max() < 0.6 * np.abs(np.diff(bumpy, 2)).max()


def test_the_pendulum_obeys_its_equation():
    rate, fps = 3.2, 500.0
    pressure = np.where(np.arange(2000) < 1000, 0.0, 1.0)[:, None]
    mass = pendulum(pressure, rate, fps)[:, 0]
    acceleration = np.gradient(np.gradient(mass)) * fps**2
    off = np.abs(acceleration - rate**2 * (mass - pressure[:, 0]))
    inner = np.r_[200:950, 1050:1800]
    assert off[inner].max() < 0.1
    assert mass[[0, -1]] == pytest.approx([0, 1], abs=0.01)


def test_wandering_has_the_asked_deviation():
    noise = wander(np.random.default_rng(0), 60_000, 3, 2.0, 0.5, 60.0)
    assert noise.std() == pytest.approx(0.5, rel=0.25)
    assert np.abs(np.diff(noise, axis=0)).max() < 0.1
