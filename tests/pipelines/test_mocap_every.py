"""MocapEvery: the body hangs from the head, floors are followed, and bad recordings are refused."""

from dataclasses import replace

import pytest
import torch

from benchmarks.rivals.last_pose import LastPoseEstimator
from watched_walk import WINDOW, drawn_pipeline, watched_walk
from wearcap.data.transforms import joint_twins
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.scores import score_in_world
from wearcap.recording import HeadStream, ImuStream
from wearcap.systems.mocap_every.features import WatchFeatures


@pytest.fixture(scope="module")
def recording():
    return watched_walk()


@pytest.mark.parametrize("floor", ["follow", "update", "points", "fixed"])
def test_the_body_is_anchored_to_the_measured_head(recording, floor):
    captured = drawn_pipeline(floor=floor).run(recording)
    motion = captured.motion
    assert len(motion) == len(recording.head.timestamps)
    torch.testing.assert_close(motion.joint("head").t, recording.head.T_world_head.t, atol=1e-4, rtol=0)
    torch.testing.assert_close(motion.joint("head").R, recording.head.T_world_head.R, atol=3e-4, rtol=0)  # float32
    assert captured.floor.height.isfinite().all()
    assert motion.provenance["floor"] == floor


def test_a_floor_that_nobody_measured_is_below_a_head_that_is_carried_lower_than_in_the_rest_pose(recording):
    unknown = replace(recording, floor=None, points=None)
    high, low = (drawn_pipeline(floor="fixed", carried=share).run(unknown) for share in (0.97, 1.0))
    above_m = 0.03 * low.motion.skeleton.height_of("head")
    torch.testing.assert_close(high.floor.height, low.floor.height + above_m, atol=1e-5, rtol=0)


def test_without_hanging_the_root_is_where_the_estimator_puts_it(recording):
    anchored, free = (drawn_pipeline(floor="fixed", anchor=anchor)(recording) for anchor in (True, False))
    assert (anchored.t_world_root - free.t_world_root).norm(dim=-1).mean() > 0.01


def test_where_a_walk_begins_and_where_it_leads_changes_nothing(recording):
    """Turned and shifted worlds give turned and shifted motions: the estimator knows no north."""
    turn, shift = about_axis("z", torch.tensor(1.1)), torch.tensor([3.0, -2.0, 0.0])
    head = recording.head
    moved_head = replace(
        head, R_world_device=turn @ head.R_world_device, t_world_device=head.t_world_device @ turn.mT + shift
    )
    imu = {
        joint: replace(stream, R_world_imu=turn @ stream.R_world_imu, acc_world=stream.acc_world @ turn.mT)
        for joint, stream in recording.imu.items()
    }
    pipeline = drawn_pipeline(floor="fixed")
    here, there = pipeline(recording), pipeline(replace(recording, head=moved_head, imu=imu))
    torch.testing.assert_close(here.T_world_joint.t @ turn.mT + shift, there.T_world_joint.t, atol=2e-3, rtol=0)


def test_with_mirror_augmentation_left_and_right_are_treated_alike(recording):
    """A recording and its mirror image then give mirror images, whatever the weights."""
    flip = torch.tensor([1.0, -1.0, 1.0])
    turn, head = torch.outer(flip, flip), recording.head
    mount = head.R_head_device * turn, head.t_head_device * flip
    seen_head = HeadStream(head.timestamps, head.R_world_device * turn, head.t_world_device * flip, *mount)
    imu = {}
    for joint, twin in (("left_wrist", "right_wrist"), ("right_wrist", "left_wrist")):
        other = recording.imu[twin]
        imu[joint] = replace(
            other,
            joint=joint,
            R_world_imu=other.R_world_imu @ other.R_joint_imu.mT * turn,
            acc_world=other.acc_world * flip,
            R_joint_imu=None,
        )
    seen = replace(recording, head=seen_head, imu=imu)
    pipeline = drawn_pipeline(floor="fixed", mirror_average=True)
    here, there = pipeline(recording), pipeline(seen)
    twins = joint_twins(here.skeleton)
    torch.testing.assert_close(here.T_world_joint.t * flip, there.T_world_joint.t[:, twins], atol=2e-3, rtol=0)
    plain = drawn_pipeline(floor="fixed", mirror_average=False)
    assert not torch.allclose(plain(recording).T_world_joint.t * flip, plain(seen).T_world_joint.t[:, twins], atol=2e-3)


@pytest.mark.parametrize("stride", [1, 4, WINDOW])
def test_any_stride_gives_every_frame_once(recording, stride):
    motion = drawn_pipeline(stride=stride, lookahead=0)(recording)
    torch.testing.assert_close(motion.timestamps, recording.head.timestamps)
    assert motion.R_parent_joint.isfinite().all()


def test_a_recording_shorter_than_a_window(recording):
    count = WINDOW // 2
    head = recording.head
    short = replace(
        recording,
        head=HeadStream(
            head.timestamps[:count],
            head.R_world_device[:count],
            head.t_world_device[:count],
            head.R_head_device,
            head.t_head_device,
        ),
    )
    with pytest.raises(WearcapError, match="at least"):
        drawn_pipeline()(short)


def test_a_gap_in_tracking_begins_anew(recording):
    head = recording.head
    kept = (head.timestamps < 1.5) | (head.timestamps > 2.5)
    gapped = replace(
        recording,
        head=HeadStream(
            head.timestamps[kept],
            head.R_world_device[kept],
            head.t_world_device[kept],
            head.R_head_device,
            head.t_head_device,
        ),
    )
    motion = drawn_pipeline()(gapped)
    assert len(motion) == len(head.timestamps)
    assert motion.R_parent_joint.isfinite().all()


def test_without_watches_those_of_the_true_motion_are_worn(recording):
    motion = drawn_pipeline()(replace(recording, imu={}))
    assert motion.R_parent_joint.isfinite().all()
    with pytest.raises(WearcapError, match="no watch on left_wrist"):
        drawn_pipeline()(replace(recording, imu={}, motion=None))


def test_three_tracked_points_need_a_truth(recording):
    pipeline = drawn_pipeline()
    features = WatchFeatures("heading", body=True, wrists="positions")
    pipeline.model = replace(pipeline.model, features=features)
    assert pipeline(recording).R_parent_joint.isfinite().all()
    with pytest.raises(WearcapError, match="no hand positions"):
        pipeline(replace(recording, motion=None))


def test_the_last_frames_estimator(recording):
    torch.manual_seed(0)
    pipeline = drawn_pipeline(stride=1, lookahead=0, floor="fixed")
    features = WatchFeatures(frame="world", absolute=False)
    net = LastPoseEstimator(features.size, features.motion_size, WINDOW, 32, 1, 2, 32, 0.0, 2).eval()
    pipeline.model = replace(pipeline.model, net=net, features=features)
    assert len(pipeline(recording)) == len(recording.head.timestamps)


@pytest.mark.parametrize(
    "wrong", [{"stride": 0}, {"stride": WINDOW + 1}, {"lookahead": WINDOW}, {"floor": "water"}, {"runtime": "fast"}]
)
def test_settings_that_cannot_be(wrong):
    with pytest.raises(WearcapError):
        drawn_pipeline(**wrong)


def test_scores_in_the_world_are_not_aligned(recording):
    motion = drawn_pipeline()(recording)
    moved = replace(motion, t_world_root=motion.t_world_root + torch.tensor([1.0, 0.0, 0.0]))
    here, there = (score_in_world(m, recording, "walk", 0).scores for m in (motion, moved))
    assert here["r_mpjpe_cm"] == pytest.approx(there["r_mpjpe_cm"], rel=1e-3)
    truth = score_in_world(recording.motion, recording, "walk", 0).scores
    assert truth["mpjpe_cm"] == pytest.approx(0.0, abs=1e-3)
    shifted = replace(recording.motion, t_world_root=recording.motion.t_world_root + torch.tensor([1.0, 0.0, 0.0]))
    assert score_in_world(shifted, recording, "walk", 0).scores["mpjpe_cm"] == pytest.approx(100.0, rel=1e-3)


def test_onnx_gives_the_same(recording):
    pytest.importorskip("onnxruntime")
    eager, fast = (drawn_pipeline(floor="fixed")(recording), drawn_pipeline(floor="fixed", runtime="onnx")(recording))
    torch.testing.assert_close(eager.T_world_joint.t, fast.T_world_joint.t, atol=1e-4, rtol=0)


def test_a_silent_watch_is_bridged_and_reported(recording):
    """The capture goes on over the watch's gap; the motion's note and the capture's report say which, when and how long."""
    left = recording.imu["left_wrist"]
    kept = (left.timestamps < 1.0) | (left.timestamps > 2.5)
    cut = ImuStream(left.timestamps[kept], "left_wrist", left.R_world_imu[kept], left.acc_world[kept])
    system = drawn_pipeline()
    with pytest.warns(UserWarning, match="left_wrist is silent"):
        captured = system.capture([replace(recording, imu=recording.imu | {"left_wrist": cut})], [0])[0]
    assert captured.report is not None
    assert "left_wrist is silent, or its clock jumps, 1 times for 1.5" in captured.report["notes"][0]
    assert captured.motion.provenance["note"] == captured.report["notes"][0]
    assert captured.motion.t_world_root.isfinite().all()
    assert system.capture([recording], [0])[0].report is None
