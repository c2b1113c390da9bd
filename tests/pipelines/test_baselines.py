"""The trivial baselines on planted data: what they must find, and what they refuse."""

import math
from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.evaluation import baselines
from wearcap.evaluation.baselines import MeanPose, NearestWindow
from wearcap.geometry import rotation
from wearcap.metrics.position import mpjpe_cm
from wearcap.recording import FloorTrack, HeadStream, Motion, Recording, RecordingStore

FPS = 30.0


def recorded(name: str, speed: float, yaw: float = 0.0, frames: int = 150, bend: float = 0.4) -> Recording:
    """Someone who walks in the direction `yaw`, knees and head bobbing at a frequency that goes with speed."""
    t = torch.arange(frames, dtype=torch.float64) / FPS
    phase = 2 * math.pi * speed * t.float()
    skeleton = xsens23()
    rotvec = torch.zeros(frames, 23, 3)
    rotvec[:, skeleton.index("left_knee"), 1] = bend * (1 + torch.sin(phase))
    rotvec[:, skeleton.index("right_knee"), 1] = bend * (1 - torch.sin(phase))
    rotvec[:, 0, 2] = yaw
    direction = torch.tensor([math.cos(yaw), math.sin(yaw)])
    height = 0.93 + 0.03 * torch.sin(2 * phase)
    root = torch.cat([speed * t.float()[:, None] * direction, height[:, None]], -1)
    motion = Motion(t, skeleton, rotation.exp(rotvec), root)
    T_world_head = motion.joint("head")
    head = HeadStream(t, T_world_head.R.clone(), T_world_head.t.clone(), torch.eye(3), torch.zeros(3))
    return Recording(
        name, head=head, motion=motion, floor=FloorTrack(t, torch.zeros(frames)), skeleton=skeleton, subject=name
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> RecordingStore:
    """Slow and fast walkers to learn from, and a test recording that must not be looked at."""
    store = RecordingStore(tmp_path_factory.mktemp("walks"))
    store.add(recorded("slow", 0.6), split="train", config_hash="0")
    store.add(recorded("fast", 1.7, yaw=0.5), split="train", config_hash="0")
    store.add(recorded("brief", 1.2, frames=20), split="train", config_hash="0")
    store.add(recorded("lying", 5.0, bend=3.0), split="test", config_hash="0")
    return store


def error_cm(motion: Motion, truth: Motion) -> float:
    return mpjpe_cm(motion.T_world_joint.t, truth.T_world_joint.t).item()


@pytest.mark.parametrize("baseline", [MeanPose, NearestWindow])
def test_head_is_where_it_was_measured(store, baseline):
    query = recorded("query", 1.1, yaw=-2.0)
    motion = baseline.fit([store])(query)
    torch.testing.assert_close(motion.timestamps, query.motion.timestamps, atol=1e-4, rtol=0)
    head, true = motion.joint("head"), query.motion.joint("head")
    torch.testing.assert_close(head.t, true.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(head.R, true.R, atol=1e-5, rtol=0)
    assert motion.skeleton == query.skeleton


def test_mean_pose_is_the_mean_of_the_training_split(store):
    fitted = MeanPose.fit([store])
    knee = fitted.R_parent_joint[xsens23().index("left_knee")]
    R = torch.cat(
        [store.load(n).motion.R_parent_joint[:, xsens23().index("left_knee")] for n in ("slow", "fast", "brief")]
    )
    torch.testing.assert_close(knee, rotation.mean_rotation(R), atol=1e-5, rtol=0)
    torch.testing.assert_close(fitted.R_parent_joint[0], torch.eye(3), atol=1e-5, rtol=0)  # faces where it looks


def test_mean_pose_turns_with_the_head(store):
    motion = MeanPose.fit([store])(recorded("query", 1.0, yaw=2.5))
    assert rotation.yaw_of(motion.R_parent_joint[:, 0]).tolist() == pytest.approx([2.5] * 150, abs=1e-4)
    local = motion.R_parent_joint[:, 1 : xsens23().index("head")]
    assert (local - local[:1]).abs().max() < 1e-6


def test_nearest_window_finds_its_own_recording_from_elsewhere(store):
    fitted = NearestWindow.fit([store], stride_s=1 / FPS)
    again = recorded("fast again", 1.7, yaw=-2.2)  # the same walk in another direction
    assert error_cm(fitted(again), again.motion) < 0.1
    assert error_cm(MeanPose.fit([store])(again), again.motion) > 1


def test_nearest_window_tells_fast_from_slow(store):
    fitted = NearestWindow.fit([store], window_s=1.0)
    for speed in (0.65, 1.6):
        query = recorded("query", speed, yaw=1.0)
        path = baselines._query_path(query, fitted.joint_names, FPS)
        raw = baselines._describe(path, torch.arange(0, 100, 10), fitted.window, fitted.sample)
        first_frame = fitted.first_frame[fitted.nearest(raw)]
        is_slow = first_frame >= 20 + 150  # laid down by name: brief, fast, slow
        assert is_slow.tolist() == [speed < 1] * 10


def test_pasted_windows_are_cross_faded_without_jumps(store):
    fitted = NearestWindow.fit([store])
    motion = fitted(recorded("query", 1.1))
    step = rotation.geodesic(motion.R_parent_joint[1:].double(), motion.R_parent_joint[:-1].double())
    assert step.max() < 0.4


def test_recordings_shorter_than_a_window(store):
    short = recorded("short", 0.6, frames=10)
    for baseline in (MeanPose, NearestWindow):
        motion = baseline.fit([store])(short)
        assert len(motion) == 10
        assert motion.R_parent_joint.isfinite().all()


def test_capture_takes_many(store):
    queries = [recorded("a", 0.7), recorded("b", 1.5, frames=40)]
    captures = MeanPose.fit([store]).capture(queries, [0, 1])
    assert [len(captured.motion) for captured in captures] == [150, 40]


def test_unfit_training_data_is_refused(tmp_path):
    store = RecordingStore(tmp_path)
    with pytest.raises(WearcapError, match="no training recordings"):
        MeanPose.fit([store])
    store.add(recorded("a", 1.0), split="train", config_hash="0")
    half = recorded("b", 1.0)
    half = replace(half, motion=half.motion.sliced(0, 70))
    store.add(half, split="train", config_hash="0")
    with pytest.raises(WearcapError, match="'b' does not fit the others"):
        NearestWindow.fit([store])


def test_foreign_skeleton_is_refused(store):
    query = recorded("query", 1.0)
    s = query.skeleton
    names = ("hips", *s.joint_names[1:])
    other = type(s)("other", names, s.parents, s.t_parent_joint, s.sites)
    with pytest.raises(WearcapError, match="skeleton is not the one"):
        MeanPose.fit([store])(type(query)("q", head=query.head, skeleton=other))
