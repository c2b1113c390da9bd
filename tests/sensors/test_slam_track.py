"""SLAM trajectories with planted outliers, and real accelerations that are none."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.sensors.monocular_slam import clean_track

cleaned = partial(clean_track, max_acceleration=40.0, max_burst_s=1.0)


def running(seconds: float = 20.0, fps: float = 30.0, noise_m: float = 0.002) -> Trajectory:
    """A head that runs at 3.5 m/s round a bend, bobs 5 cm up and down 2.8 times a second, lands hard, and stops dead."""
    random = torch.Generator().manual_seed(0)
    time = torch.arange(int(seconds * fps), dtype=torch.float64) / fps
    travelled = 3.5 * time.clamp(max=0.8 * seconds)
    angle = travelled / 6
    step = 2 * torch.pi * 2.8 * time
    height = 1.6 + 0.05 * torch.sin(step) + 0.012 * torch.sin(2 * step)
    position = torch.stack([6 * angle.sin() + 0.02 * torch.sin(step / 2), -6 * angle.cos(), height], -1)
    position += noise_m * torch.randn(len(time), 3, generator=random, dtype=torch.float64)
    return Trajectory(time, rotation.about_axis("z", angle).float(), position.float())


def moved(track: Trajectory, frames, by) -> Trajectory:
    position = track.t_world_body.clone()
    position[frames] += torch.as_tensor(by)
    return replace(track, t_world_body=position)


def test_a_running_head_is_left_alone():
    _, valid, jumps = cleaned(running())
    assert valid.all()
    assert not len(jumps)


@pytest.mark.parametrize("frame", [0, 77, 300, 599])
@pytest.mark.parametrize("size", [0.15, 5.0])
def test_a_single_outlier_falls_alone_and_is_interpolated(frame, size):
    track = running()
    filled, valid, _ = cleaned(moved(track, frame, [0.0, size, 0.0]))
    assert (~valid).nonzero()[:, 0].tolist() == [frame]
    assert (filled.t_world_body - track.t_world_body).norm(dim=-1).max() < 0.15
    assert torch.equal(filled.timestamps, track.timestamps)


@pytest.mark.parametrize("frame", [1, 598])
def test_next_to_an_end_one_good_frame_may_fall_too(frame):
    _, valid, _ = cleaned(moved(running(), frame, [0.3, 0.0, 0.0]))
    fallen = (~valid).nonzero()[:, 0].tolist()
    assert frame in fallen
    assert set(fallen) <= {0, 1} | {598, 599}


@pytest.mark.parametrize("length", [2, 3, 9, 25])
def test_a_burst_falls_as_a_whole(length):
    """Whether its positions are shifted alike, or each to a place of its own."""
    track, frames = running(), torch.arange(200, 200 + length)
    for by in (torch.tensor([0.4, 0.0, 0.3]), torch.randn(length, 3, generator=torch.Generator().manual_seed(1))):
        _, valid, jumps = cleaned(moved(track, frames, by))
        assert (~valid).nonzero()[:, 0].tolist() == frames.tolist()
        assert not len(jumps)


def test_many_outliers_at_once():
    track = running()
    random = torch.Generator().manual_seed(3)
    bad = torch.rand(len(track), generator=random) < 0.05
    by = torch.randn(int(bad.sum()), 3, generator=random).sign() * 0.5
    _, valid, _ = cleaned(moved(track, bad, by))
    assert not (valid & bad).any()
    assert (~valid & ~bad).sum() <= 5
    filled = cleaned(moved(track, bad, by))[0]
    first, last = valid.nonzero()[[0, -1], 0].tolist()
    assert (filled.t_world_body - track.t_world_body).norm(dim=-1)[first:last].max() < 0.15


def test_rotations_are_filled_too():
    track = moved(running(), 50, [1.0, 0.0, 0.0])
    R = track.R_world_body.clone()
    R[50] = rotation.about_axis("x", torch.tensor(2.0))
    filled = cleaned(replace(track, R_world_body=R))[0]
    assert rotation.geodesic(filled.R_world_body, running().R_world_body).max() < 1e-3


def test_a_lasting_jump_is_reported_and_not_cut_away():
    track = running()
    _, valid, jumps = cleaned(moved(track, slice(250, None), [0.0, 2.0, 0.0]))
    assert valid.all()
    assert jumps.tolist() == pytest.approx([track.timestamps[249].item()])


def test_frames_without_numbers():
    track = moved(running(), [10, 11, 12], [torch.nan] * 3)
    filled, valid, _ = cleaned(track)
    assert (~valid).nonzero()[:, 0].tolist() == [10, 11, 12]
    assert filled.t_world_body.isfinite().all()
    with pytest.raises(WearcapError, match="no pose of the trajectory is finite"):
        cleaned(moved(track, slice(None), [torch.nan] * 3))
    with pytest.raises(WearcapError, match="repeats the one before"):
        cleaned(replace(track, timestamps=torch.zeros_like(track.timestamps)))


@pytest.mark.parametrize("length", [1, 2, 3])
def test_short_tracks(length):
    assert cleaned(running()[:length])[1].all()


@pytest.mark.real
def test_a_real_wearer_is_left_alone(real_data):
    """A Project Aria path at 30 Hz: nothing is cut, and planted outliers fall alone."""
    from wearcap.io.devices.aria_mps import read_closed_loop

    path = next((real_data / "aria_mps").rglob("closed_loop_trajectory.csv*"))
    whole = read_closed_loop(path)[0]
    count = int((whole.timestamps[-1] - whole.timestamps[0]).item() * 30)
    track = resample(whole, whole.timestamps[0] + torch.arange(count, dtype=torch.float64) / 30)
    assert cleaned(track)[1].all()
    _, valid, _ = cleaned(moved(track, [40, 90, 91, 92, 200], [0.1, 0.1, 0.0]))
    assert (~valid).nonzero()[:, 0].tolist() == [40, 90, 91, 92, 200]
