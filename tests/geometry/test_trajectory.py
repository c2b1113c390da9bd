"""Trajectories: slerp, velocities of known motions, outliers, gaps, smoothing, hostile timestamps."""

import math

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import (
    Trajectory,
    angular_velocity,
    filled,
    find_gaps,
    finite_difference,
    interpolate,
    interpolate_clamped,
    linear_velocity,
    outlier_mask,
    resample,
    smooth,
)

VELOCITY = torch.tensor([1.0, -0.5, 0.2], dtype=torch.float64)
SPIN = torch.tensor([0.3, -0.4, 1.2], dtype=torch.float64)


def screw(timestamps: torch.Tensor) -> Trajectory:
    """Constant velocity and constant spin about a fixed world axis."""
    start = rotation.exp(torch.tensor([0.5, 0.1, -0.7], dtype=torch.float64))
    return Trajectory(timestamps, rotation.exp(timestamps[:, None] * SPIN) @ start, timestamps[:, None] * VELOCITY)


def walk(frames: int, fps: float = 30.0) -> Trajectory:
    timestamps = torch.arange(frames, dtype=torch.float64) / fps
    return screw(timestamps)


def test_resampling_a_screw_is_exact():
    uneven = torch.tensor([0.0, 0.1, 0.15, 0.4, 1.0, 1.3], dtype=torch.float64)
    at = torch.linspace(0, 1.3, 40, dtype=torch.float64)
    got, expected = resample(screw(uneven), at), screw(at)
    assert torch.equal(got.timestamps, at)
    assert torch.allclose(got.t_world_body, expected.t_world_body, atol=1e-12)
    assert torch.allclose(got.R_world_body, expected.R_world_body, atol=1e-9)


def test_resampling_at_its_own_times_changes_nothing():
    track = walk(20)
    again = resample(track, track.timestamps)
    assert torch.allclose(again.t_world_body, track.t_world_body, atol=1e-14)
    assert torch.allclose(again.R_world_body, track.R_world_body, atol=1e-12)


def test_resampling_float32_with_unix_timestamps():
    track = walk(20)
    late = Trajectory(track.timestamps + 1.7e9, track.R_world_body.float(), track.t_world_body.float())
    at = late.timestamps[:-1] + 1 / 60
    got = resample(late, at)
    assert got.t_world_body.dtype == torch.float32
    assert torch.allclose(got.t_world_body.double(), (at - 1.7e9)[:, None] * VELOCITY, atol=1e-5)


def test_ends_are_held_for_one_step_and_no_longer():
    track = walk(10)
    end = track.timestamps[-1]
    held = resample(track, (end + 0.9 / 30)[None])
    assert torch.equal(held.t_world_body[0], track.t_world_body[-1])
    with pytest.raises(WearcapError, match="outside"):
        resample(track, (end + 1.2 / 30)[None])
    with pytest.raises(WearcapError, match="outside"):
        resample(track, torch.tensor([math.nan], dtype=torch.float64))


def test_interpolate_values():
    time = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    value = torch.tensor([[0.0], [10.0], [30.0]])
    at = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    assert interpolate(time, value, at)[:, 0].tolist() == [5.0, 10.0, 20.0]


def test_velocities_of_a_screw():
    uneven = torch.tensor([0.0, 0.1, 0.15, 0.4, 1.0, 1.3], dtype=torch.float64)
    track = screw(uneven)
    assert torch.allclose(linear_velocity(track), VELOCITY.expand(6, 3), atol=1e-12)
    assert torch.allclose(angular_velocity(track), SPIN.expand(6, 3), atol=1e-9)
    assert torch.allclose(finite_difference(track.t_world_body, uneven), VELOCITY.expand(6, 3), atol=1e-12)


def test_velocities_of_one_frame_are_zero():
    assert linear_velocity(walk(1)).tolist() == [[0, 0, 0]]
    assert angular_velocity(walk(1)).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("bad", [[17], [0], [59], [10, 11, 12, 13], [5, 30, 31, 50], [20, 22, 24, 26]], ids=str)
def test_outliers_fall_and_good_neighbours_stay(bad):
    track = walk(60)
    position = track.t_world_body.clone()
    position[bad] += torch.tensor([3.0, 4.0, 0.0], dtype=torch.float64)
    wrong = Trajectory(track.timestamps, track.R_world_body, position)
    valid = outlier_mask(wrong, max_speed=3.0)
    assert (~valid).nonzero()[:, 0].tolist() == bad
    mended = filled(wrong, valid)
    inner = torch.tensor([i for i in range(60) if i not in (0, 59)])
    assert torch.allclose(mended.t_world_body[inner], track.t_world_body[inner], atol=1e-9)


def test_outlier_mask_leaves_no_neighbours_too_fast():
    generator = torch.Generator().manual_seed(0)
    track = walk(400)
    noise = torch.randn(400, 3, generator=generator, dtype=torch.float64) * 5
    struck = torch.rand(400, generator=generator) < 0.4
    position = track.t_world_body + noise * struck[:, None]
    position[7] = math.nan
    wrong = Trajectory(track.timestamps, track.R_world_body, position)
    valid = outlier_mask(wrong, max_speed=3.0)
    good = wrong[valid]
    assert (good.t_world_body.diff(dim=0).norm(dim=-1) / good.timestamps.diff() <= 3.0).all()
    assert not valid[7]
    assert valid[~struck & (torch.arange(400) != 7)].double().mean() > 0.9
    assert not valid[struck].double().mean() > 0.1


def test_a_clean_track_has_no_outliers_and_nothing_valid_cannot_be_filled():
    track = walk(30)
    assert outlier_mask(track, max_speed=3.0).all()
    with pytest.raises(WearcapError, match="no valid pose"):
        filled(track, torch.zeros(30, dtype=torch.bool))


def test_gaps():
    time = torch.tensor([0.0, 0.1, 0.2, 0.9, 1.0, 3.0], dtype=torch.float64)
    assert find_gaps(time, 0.15).tolist() == [2, 4]
    assert find_gaps(time, 5.0).tolist() == []


def test_smoothing_keeps_a_straight_line_and_reduces_noise():
    track = walk(120)
    calm = smooth(track, sigma_s=0.1)
    middle = slice(15, -15)
    assert torch.allclose(calm.t_world_body[middle], track.t_world_body[middle], atol=1e-6)
    assert torch.allclose(calm.R_world_body[middle], track.R_world_body[middle], atol=1e-6)
    generator = torch.Generator().manual_seed(3)
    shake = rotation.exp(0.1 * torch.randn(120, 3, generator=generator, dtype=torch.float64))
    shift = 0.05 * torch.randn(120, 3, generator=generator, dtype=torch.float64)
    noisy = Trajectory(track.timestamps, track.R_world_body @ shake, track.t_world_body + shift)
    calm = smooth(noisy, sigma_s=0.1)
    error = lambda other: (other.t_world_body - track.t_world_body)[middle].norm(dim=-1).mean()  # noqa: E731
    turned = lambda other: rotation.geodesic(other.R_world_body, track.R_world_body)[middle].mean()  # noqa: E731
    assert error(calm) < 0.5 * error(noisy)
    assert turned(calm) < 0.5 * turned(noisy)
    eye = torch.eye(3, dtype=torch.float64).expand(120, 3, 3)
    assert torch.allclose(calm.R_world_body @ calm.R_world_body.mT, eye, atol=1e-9)


@pytest.mark.parametrize(
    ("times", "word"),
    [
        ([0.0, 0.1, 0.1], "repeats"),
        ([0.0, 0.2, 0.1], "before its predecessor"),
        ([0.0, math.nan, 0.2], "not a number"),
        ([0.0, math.inf, 0.2], "not a number"),
    ],
)
@pytest.mark.parametrize(
    "function",
    [
        linear_velocity,
        angular_velocity,
        lambda t: outlier_mask(t, 3.0),
        lambda t: smooth(t, 0.1),
        lambda t: resample(t, t.timestamps[:1]),
        lambda t: find_gaps(t.timestamps, 0.1),
    ],
)
def test_hostile_timestamps_are_named(times, word, function):
    track = walk(3)
    bad = Trajectory(torch.tensor(times, dtype=torch.float64), track.R_world_body, track.t_world_body)
    with pytest.raises(WearcapError, match=word) as caught:
        function(bad)
    assert "frame" in str(caught.value)


def test_values_beyond_the_ends_are_held():
    known, value = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64), torch.tensor([10.0, 20.0, 0.0])
    at = torch.tensor([-5.0, 1.0, 1.25, 3.0, 4.0, 9.0], dtype=torch.float64)
    assert interpolate_clamped(known, value, at).tolist() == [10.0, 10.0, 12.5, 10.0, 0.0, 0.0]
    assert interpolate_clamped(known[:1], value[:1], at).tolist() == [10.0] * 6
