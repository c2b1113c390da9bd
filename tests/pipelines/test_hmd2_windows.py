"""HMD²'s windows: noise belongs to frames, what is final stays, what differs fades out."""

import pytest
import torch
from test_hmd2 import pipeline, seeing_recording

from wearcap.errors import WearcapError
from wearcap.runtime.windows import cut
from wearcap.systems.hmd2.windows import blended
from wearcap.tracking.head_path import head_path


def test_new_frames_continue_from_observed_ones_and_fade_into_the_prediction():
    torch.manual_seed(0)
    x0_hat, observed = torch.randn(3, 30, 4), torch.randn(3, 30, 4)
    x0_hat[1], observed[1] = 0.0, torch.arange(30.0)[:, None]
    number = torch.arange(30)
    is_observed = torch.stack([number < 0, number < 10, number < 1])
    whole = blended(x0_hat, observed, is_observed, 8)
    assert torch.equal(whole[is_observed], observed[is_observed])
    assert torch.equal(whole[0], x0_hat[0]), "nothing is observed"
    assert torch.allclose(whole[:, 17:], x0_hat[:, 17:], atol=1e-6)
    assert torch.allclose(whole[2, 8:], x0_hat[2, 8:], atol=1e-6), "one frame has no slope"
    steps = whole[1, 8:19, 0].diff()
    assert steps[0] == pytest.approx(1.0)
    assert 0.3 < steps[1] < 1.0, "it goes on as it went, and turns back"
    assert steps.diff().abs().max() < 1.1, "without a kink, on a path of nine in eight frames"
    step = blended(x0_hat, observed, is_observed, 0)
    assert torch.equal(step, torch.where(is_observed[..., None], observed, x0_hat))


def windows(hmd2, frames: int):
    """The sampler of a recording, window after window."""
    recording = seeing_recording(frames)
    path = head_path(recording, hmd2.model.skeleton, hmd2.model.fps)
    hmd2.prepare()
    conditions, sampler = hmd2.sense(recording, path), hmd2.sampler(path.skeleton, 0, 0)
    for start in range(0, frames, hmd2.advance):
        sampler.push(cut(conditions, slice(start, start + hmd2.advance)))
        hmd2.predict([sampler])
        yield sampler


def test_every_window_sees_the_same_noise_at_the_same_moment():
    last = None
    for sampler in windows(pipeline(stride=10, lookahead=20), 120):
        assert sampler.count <= 60
        if last is not None:
            moved = last.shape[1] + 10 - sampler.count
            assert torch.equal(sampler.predicted.noise[:, : last.shape[1] - moved], last[:, moved:])
        last = sampler.predicted.noise
    assert last is not None
    assert last.std() == pytest.approx(1.0, abs=0.02)


def test_final_poses_stay_and_lookahead_frames_are_re_denoised():
    final_poses, lookahead = [], []
    for sampler in windows(pipeline(fade=8, stride=10, lookahead=20), 100):
        given, final = sampler.take(), sampler.final_count
        poses = torch.zeros(0, 23, 3, 3) if given is None else given.R_parent_joint
        if len(poses):
            assert torch.equal(sampler.predicted.R_parent_joint[0, final - len(poses) : final], poses)
            output = torch.cat([*final_poses, poses])[-final:]
            assert torch.equal(sampler.predicted.R_parent_joint[0, final - len(output) : final], output)
        final_poses.append(poses)
        lookahead.append(sampler.predicted.R_parent_joint[0, final:])
    assert len(torch.cat(final_poses)) == 80
    assert not torch.allclose(lookahead[-2][10:], lookahead[-1][:10], atol=1e-5)


def test_windows_do_not_look_further_ahead_than_they_share():
    with pytest.raises(WearcapError, match="windows that share 20 frames cannot look 21 ahead"):
        pipeline(lookahead=21)(seeing_recording(80))


def test_a_window_splits_into_tokens_and_is_no_longer_than_the_networks():
    assert pipeline(window=400).window == 60
    with pytest.raises(WearcapError, match="a window of 42 frames does not split into tokens of 4"):
        pipeline(window=42)(seeing_recording(80))


def test_strides_and_lookahead_follow_from_the_window():
    hmd2 = pipeline(inpaint=True, stride=None)
    assert (hmd2.advance, hmd2.lookahead_frames) == (45, 0)
    anew = pipeline(stride=None)
    assert (anew.advance, anew.lookahead_frames) == (30, 15)
