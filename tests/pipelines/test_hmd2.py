"""HMD² as a pipeline: the head stays where it was measured, windows join, batches change nothing."""

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.data.features import HeadFeatures
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.errors import WearcapError
from wearcap.models.denoiser import MotionDenoiser
from wearcap.pipelines.evaluation import evaluate
from wearcap.pipelines.hmd2 import HMD2, hang_from_head
from wearcap.recording import Recording
from wearcap_testing import recording_of, small_dataset, swaying_motion


def pipeline(frame: str = "heading", **changes) -> HMD2:
    torch.manual_seed(0)
    features = HeadFeatures(frame)
    net = MotionDenoiser(features.motion_size, features.condition_size, 60, 32, 1, 4, 64, 0.0, 4)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    return HMD2(net, features, CosineSchedule(), xsens23(), 60.0, **{"steps": 3, "stride": 40} | changes)


@pytest.mark.parametrize("frame", ["heading", "window"])
def test_the_head_is_where_it_was_measured(frame):
    recording = recording_of(swaying_motion(150), "a")
    motion = pipeline(frame)(recording)
    assert torch.equal(motion.timestamps, recording.motion.timestamps)
    assert torch.allclose(motion.joint("head").t, recording.motion.joint("head").t, atol=1e-4)
    assert torch.allclose(motion.joint("head").R, recording.motion.joint("head").R, atol=1e-4)


def test_recordings_in_one_batch_come_out_as_alone():
    recordings = [recording_of(swaying_motion(n, n), f"r{n}") for n in (150, 70, 20)]
    together = pipeline().capture(recordings, [5, 6, 7])
    for recording, seed, motion in zip(recordings, (5, 6, 7), together):
        alone = pipeline()(recording, seed)
        assert torch.allclose(motion.R_parent_joint, alone.R_parent_joint, atol=1e-4)


def test_the_same_seed_repeats_and_another_differs():
    recording = recording_of(swaying_motion(100), "a")
    first, again, other = (pipeline()(recording, seed).R_parent_joint for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.allclose(first, other, atol=1e-3)


@pytest.mark.parametrize("frame", ["heading", "window"])
def test_what_was_said_stays_said(frame):
    """Frames that a window has given out are not revised by the next: a longer recording begins the same."""
    long = swaying_motion(140)
    short = recording_of(long.sliced(0, 60), "short")
    captured, prefix = pipeline(frame)(recording_of(long, "long")), pipeline(frame)(short)
    assert torch.allclose(captured.R_parent_joint[:60], prefix.R_parent_joint, atol=1e-4)


def test_a_stride_longer_than_the_window_is_refused():
    with pytest.raises(WearcapError, match="cannot advance by 61"):
        pipeline(stride=61)(recording_of(swaying_motion(80), "a"))


def test_a_recording_without_head_poses_is_named():
    with pytest.raises(WearcapError, match="blind: no head poses"):
        pipeline()(Recording("blind"))


def test_hanging_the_truth_from_its_own_head_changes_nothing():
    truth = swaying_motion(50)
    hung = hang_from_head(truth, truth.joint("head"))
    assert torch.allclose(hung.T_world_joint.t, truth.T_world_joint.t, atol=1e-5)


def test_evaluation_scores_every_recording_once_per_seed(tmp_path):
    store = small_dataset(tmp_path)
    rows = list(evaluate(pipeline(), store, store.names("test"), [0, 1], lanes=3))
    assert sorted((row.recording, row.seed) for row in rows) == [(n, s) for n in ("r4", "r5") for s in (0, 1)]
    assert all(row.scores["mpjpe_cm"] > 1 for row in rows)
    assert {row.frames for row in rows} == {260, 300}
