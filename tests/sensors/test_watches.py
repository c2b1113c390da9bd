"""Watches on the camera's clock: interpolated, averaged, filtered; and what no capture should start with."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import WRISTS, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis, geodesic
from wearcap.recording import ImuStream
from wearcap.sensors.watches import filtered, watches_at
from wearcap.systems.mocap_every.features import synthetic_wrists
from wearcap_testing import swaying_motion

CLOCK = torch.arange(90, dtype=torch.float64) / 30 + 1.0


def hanging(joint: str, times: torch.Tensor) -> ImuStream:
    """A watch on an arm that hangs and swings; its acceleration is a slow wave."""
    side = 1.0 if joint == "left_wrist" else -1.0
    R = about_axis("x", torch.full((len(times),), -side * 1.4)) @ about_axis("z", 0.3 * times.float().sin())
    acc = torch.stack([times.sin(), times.cos(), torch.zeros_like(times)], -1).float()
    return ImuStream(times, joint, R.float(), acc)


def both(rate: float, start: float = 0.0, stop: float = 5.0) -> dict[str, ImuStream]:
    times = torch.arange(start, stop, 1 / rate, dtype=torch.float64)
    return {joint: hanging(joint, times) for joint in WRISTS}


@pytest.mark.parametrize("rate", [30.0, 50.0, 100.0, 200.0])
def test_any_rate_gives_the_same(rate):
    R, acc = watches_at(both(rate), CLOCK, "here")
    truth = {joint: hanging(joint, CLOCK) for joint in WRISTS}
    for k, joint in enumerate(WRISTS):
        assert geodesic(R[:, k], truth[joint].R_world_imu).max().rad2deg() < 0.05
        # A mean over 7 frames of a wave of 2π s takes less than half a percent off it.
        assert (acc[4:-4, k] - truth[joint].acc_world[4:-4]).abs().max() < 0.01


def test_orientation_turns_evenly_between_samples():
    times = torch.tensor([0.0, 1.0], dtype=torch.float64)
    turn = about_axis("x", torch.tensor([-1.4, -1.4]))
    stream = ImuStream(times, "left_wrist", turn @ about_axis("z", torch.tensor([0.0, 1.0])), torch.zeros(2, 3))
    quarter = torch.tensor([0.25], dtype=torch.float64)
    R, _ = filtered([stream], quarter, quarter.expand(7), 1 / 30)
    expected = turn[:1] @ about_axis("z", torch.tensor([0.25]))
    torch.testing.assert_close(R[:, 0], expected, atol=1e-5, rtol=0)


def test_a_spike_is_spread_over_seven_frames():
    streams = both(30.0)
    spiked = {joint: replace(stream, acc_world=torch.zeros_like(stream.acc_world)) for joint, stream in streams.items()}
    spiked["left_wrist"].acc_world[60, 0] = 7.0
    _, acc = watches_at(spiked, CLOCK, "here")
    assert acc[:, 0, 0].sum() == pytest.approx(7.0, rel=1e-3)
    assert int((acc[:, 0, 0] > 0.1).sum()) in (7, 8, 9)
    assert not acc[:, 1].any()


def test_mounting_is_taken_off():
    mount = about_axis("z", torch.tensor(0.7))
    plain = both(100.0)
    mounted = {
        joint: replace(stream, R_world_imu=stream.R_world_imu @ mount, R_joint_imu=mount)
        for joint, stream in plain.items()
    }
    torch.testing.assert_close(watches_at(plain, CLOCK, "a")[0], watches_at(mounted, CLOCK, "a")[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {"left_wrist": s["left_wrist"]}, "no watch on right_wrist"),
        (
            lambda s: s | {"left_wrist": replace(s["left_wrist"], acc_world=None)},
            "without orientation or free acceleration",
        ),
        (lambda s: both(100.0, start=2.0), "logged from 2.00 s"),
        (lambda s: both(100.0, stop=3.0), "logged from 0.00 s to"),
        (
            lambda s: s | {"left_wrist": replace(s["left_wrist"], timestamps=s["left_wrist"].timestamps.flip(0))},
            "do not grow",
        ),
    ],
)
def test_what_is_refused(change, message):
    with pytest.raises(WearcapError, match=message):
        watches_at(change(both(100.0)), CLOCK, "here")


def test_raised_arms_are_captured_with_a_warning():
    streams = both(100.0)
    with pytest.warns(UserWarning, match="raised arms, or swapped watches"):
        watches_at({"left_wrist": streams["right_wrist"], "right_wrist": streams["left_wrist"]}, CLOCK, "here")


def test_a_gap_is_bridged_as_streams_do_it():
    """Last orientation, no acceleration; a warning says so, and outside of the gap nothing changes."""
    streams = both(100.0)
    left = streams["left_wrist"]
    kept = (left.timestamps < 2.0) | (left.timestamps > 3.2)
    cut = ImuStream(left.timestamps[kept], "left_wrist", left.R_world_imu[kept], left.acc_world[kept])
    gapped = streams | {"left_wrist": cut}
    with pytest.warns(UserWarning, match="left_wrist is silent, or its clock jumps, 1 times for 1.2. s in all"):
        R, acc = watches_at(gapped, CLOCK, "here")
    whole_R, whole_acc = watches_at(streams, CLOCK, "here")
    inside = (CLOCK > 2.2) & (CLOCK < 3.0)
    last = left.R_world_imu[left.timestamps < 2.0][-1]
    assert geodesic(R[inside, 0], last.expand(int(inside.sum()), 3, 3)).max().rad2deg() < 0.05
    assert acc[inside, 0].abs().max() < 1e-6
    outside = (CLOCK < 1.8) | (CLOCK > 3.4)
    torch.testing.assert_close(R[outside], whole_R[outside], atol=1e-5, rtol=0)
    torch.testing.assert_close(acc[outside], whole_acc[outside], atol=1e-4, rtol=0)
    torch.testing.assert_close(R[:, 1], whole_R[:, 1], atol=1e-5, rtol=0)


def test_a_silence_outside_the_capture_does_not_matter():
    streams = both(100.0, stop=8.0)
    times = streams["left_wrist"].timestamps
    kept = (times < 5.5) | (times > 6.5)
    left = streams["left_wrist"]
    streams["left_wrist"] = ImuStream(times[kept], "left_wrist", left.R_world_imu[kept], left.acc_world[kept])
    assert watches_at(streams, CLOCK, "here")[0].isfinite().all()


def test_synthetic_accelerations_are_those_of_equation_8():
    """n = 4 frames of 30 in a second on either side, then a mean over 7, whatever the motion's own rate."""
    motion = swaying_motion(240)
    _, acc, position = synthetic_wrists(xsens23(), motion.R_parent_joint, motion.t_world_root, 60.0, every=2)
    p, t = position[:, 0].double(), 100
    at = [(p[s + 8] + p[s - 8] - 2 * p[s]) / (8 / 60) ** 2 for s in range(t - 6, t + 7, 2)]
    torch.testing.assert_close(acc[t, 0].double(), torch.stack(at).mean(0), atol=1e-4, rtol=1e-3)
