"""Captures by the pose regressor: causal, anchored to the measured head, hands where they were measured."""

from dataclasses import replace

import pytest
import torch

from benchmarks.rivals.pose_regression.features import TrackedPoints
from benchmarks.rivals.pose_regression.net import PoseRegressor
from benchmarks.rivals.pose_regression.pipeline import PoseRegressorCapture
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap_testing import recording_of, swaying_motion

HANDS = ("head", "left_wrist", "right_wrist")


def pipeline(points: tuple[str, ...] = ("head",), **changes) -> PoseRegressorCapture:
    torch.manual_seed(0)
    tracked = TrackedPoints(points, "world")  # a floor from the whole path would give away the future
    net = PoseRegressor(tracked.size, 138, 40, 32, 2, 4, 64, frames_per_token=4)
    # Bends of some degrees about the rest pose, as a trained one tells them.
    rest = HeadFeatures().encode(torch.eye(3).expand(1, 1, 23, 3, 3), torch.eye(3)[None, None], torch.zeros(1, 1, 2))
    net.motion_normalizer.set(rest[0, 0], torch.full((138,), 0.2))
    return PoseRegressorCapture(net, tracked, xsens23(), 60.0, **changes)


@pytest.mark.parametrize("points", [("head",), HANDS])
def test_the_head_is_where_it_was_measured_and_so_are_tracked_hands(points):
    recording = recording_of(swaying_motion(150), "a")
    motion, truth = pipeline(points)(recording), recording.motion
    assert torch.equal(motion.timestamps, truth.timestamps)
    assert torch.allclose(motion.joint("head").t, truth.joint("head").t, atol=1e-4)
    assert torch.allclose(motion.joint("head").R, truth.joint("head").R, atol=1e-4)
    off = (motion.joint("left_wrist").t - truth.joint("left_wrist").t).norm(dim=-1)
    raw = (pipeline(points, reach=False)(recording).joint("left_wrist").t - truth.joint("left_wrist").t).norm(dim=-1)
    if points == HANDS:
        assert off.mean() < 0.3 * raw.mean()
    else:
        assert torch.allclose(off, raw)


@pytest.mark.parametrize("points", [("head",), HANDS])
def test_no_frame_depends_on_a_later_one(points):
    long = swaying_motion(140)
    whole = pipeline(points)(recording_of(long, "long"))
    prefix = pipeline(points)(recording_of(long.sliced(0, 60), "short"))
    assert torch.allclose(whole.R_parent_joint[:60], prefix.R_parent_joint, atol=1e-4)


def test_behind_a_jump_of_the_tracking_a_new_past_begins():
    recording = recording_of(swaying_motion(120), "jumps")
    shift = torch.zeros(120, 3)
    shift[70:, 0] = 5.0
    head = replace(recording.head, t_world_device=recording.head.t_world_device + shift)
    jumped = pipeline()(replace(recording, head=head))
    behind = pipeline()(recording_of(swaying_motion(120).sliced(70, 120), "behind"))
    assert torch.allclose(jumped.R_parent_joint[70:], behind.R_parent_joint, atol=1e-4)
    assert torch.allclose(jumped.joint("head").t[70:], behind.joint("head").t + shift[70:], atol=1e-4)


def test_passes_and_company_change_nothing():
    recordings = [recording_of(swaying_motion(n, n), f"r{n}") for n in (150, 20)]
    together = pipeline(frames_per_pass=64).capture(recordings, [0, 1])
    for recording, captured in zip(recordings, together):
        assert torch.allclose(captured.motion.R_parent_joint, pipeline()(recording).R_parent_joint, atol=1e-5)


def test_hands_need_a_true_motion_and_the_head_does_not():
    recording = replace(recording_of(swaying_motion(100), "r"), motion=None)
    assert len(pipeline()(recording)) == 100
    with pytest.raises(WearcapError, match="no tracked hands in this recording"):
        pipeline(HANDS)(recording)


def test_the_true_motion_may_keep_another_clock():
    recording = recording_of(swaying_motion(120), "r")
    slow = recording.motion
    half = replace(
        slow,
        timestamps=slow.timestamps[::2].clone(),
        R_parent_joint=slow.R_parent_joint[::2],
        t_world_root=slow.t_world_root[::2],
    )
    whole, resampled = pipeline(HANDS)(recording), pipeline(HANDS)(replace(recording, motion=half))
    assert (whole.R_parent_joint - resampled.R_parent_joint)[:110].abs().max() < 0.1
