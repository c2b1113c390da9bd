"""The pose regressor and what it sees of tracked points."""

import pytest
import torch

from benchmarks.rivals.pose_regression.features import TrackedPoints, pasts
from benchmarks.rivals.pose_regression.net import PoseRegressor
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap_testing import swaying_motion

HANDS = ("head", "left_wrist", "right_wrist")


def small(**changes) -> PoseRegressor:
    torch.manual_seed(0)
    settings = {"feature_size": 5, "motion_size": 12, "window": 8, "width": 32, "layers": 2, "heads": 4}
    return PoseRegressor(**settings | {"feedforward": 64} | changes).eval()


@pytest.mark.parametrize("frames_per_token", [1, 4])
def test_frames_that_do_not_exist_are_not_looked_at_and_the_others_are(frames_per_token):
    net = small(frames_per_token=frames_per_token)
    features, valid = torch.randn(3, 8, 5), torch.ones(3, 8, dtype=torch.bool)
    valid[:, :3] = False
    out = net(features, valid)
    assert out.shape == (3, 12)
    changed = features.clone()
    changed[:, :3] = 99.0
    assert torch.allclose(net(changed, valid), out, atol=1e-5)
    for frame in (3, 7):
        changed = features.clone()
        changed[:, frame] += 1.0
        assert not torch.allclose(net(changed, valid), out, atol=1e-3)
    assert not torch.allclose(net(features, valid | True), out, atol=1e-3)
    assert not torch.allclose(net(features[:, [0, 1, 2, 4, 3, 5, 6, 7]], valid), out, atol=1e-4)


def test_it_starts_from_the_mean_and_refuses_windows_that_do_not_split():
    net = small()
    mean = torch.randn(12)
    net.motion_normalizer.set(mean, torch.full((12,), 1e-6))
    assert torch.allclose(net(torch.randn(1, 8, 5), torch.ones(1, 8, dtype=torch.bool))[0], mean, atol=1e-4)
    with pytest.raises(ValueError, match="does not split"):
        small(frames_per_token=3)


def test_pasts_end_where_asked_and_begin_before_the_first_frame_with_nothing():
    frames = torch.arange(10.0)[None, :, None]
    past, exists = pasts(frames, torch.tensor([[1, 9]]), 4)
    assert past[0, 1, :, 0].tolist() == [6, 7, 8, 9]
    assert exists[0].tolist() == [[False, False, True, True], [True] * 4]
    assert past[0, 0, 2:, 0].tolist() == [0, 1]


def encoded(points: TrackedPoints, motion, turn=None, shift=None, floor: float = 0.0):
    head = motion.joint("head")
    turn = torch.eye(3) if turn is None else turn
    shift = torch.zeros(3) if shift is None else shift
    R = motion.R_parent_joint.clone()
    R[:, 0] = turn @ R[:, 0]
    head = Rigid(turn @ head.R, (turn @ head.t[..., None])[..., 0] + shift)
    poses = points.poses(motion.skeleton, head, R)
    stature = torch.tensor([motion.skeleton.height_of("head")])
    return points.encode(poses.R[None], poses.t[None], torch.full((1, len(motion)), floor), stature, motion.fps)[0]


@pytest.mark.parametrize("height", ["stature", "floor", "world"])
def test_features_do_not_depend_on_place_and_heading(height):
    motion, points = swaying_motion(30), TrackedPoints(HANDS, height)
    features = encoded(points, motion)
    assert features.shape == (30, points.size)
    turn = rotation.about_axis("z", torch.tensor(2.0))
    moved = encoded(points, motion, turn, torch.tensor([3.0, -5.0, 0.0]))
    assert torch.allclose(moved, features, atol=1e-3)
    upstairs = encoded(points, motion, shift=torch.tensor([0.0, 0.0, 2.0]), floor=2.0)
    assert torch.allclose(upstairs, features, atol=1e-3) == (height != "world")


def test_features_are_the_points_rotation_change_position_and_velocity():
    """Against plain formulas, for the left wrist of one frame."""
    motion, frame = swaying_motion(30), 17
    seen = encoded(TrackedPoints(HANDS, "floor"), motion, floor=0.25)[frame, 18:36]
    head, wrist = motion.joint("head"), motion.joint("left_wrist")
    R = rotation.about_axis("z", -rotation.yaw_of(head.R[frame]))
    step = wrist.R[frame - 1].T @ wrist.R[frame]
    expected = [
        (R @ wrist.R[frame])[:, 0],
        (R @ wrist.R[frame])[:, 1],
        (step - torch.eye(3))[:, 0] * 60,
        (step - torch.eye(3))[:, 1] * 60,
        (R @ (wrist.t[frame] - head.t[frame]))[:2],
        wrist.t[frame, 2:] - 0.25,
        R @ (wrist.t[frame] - wrist.t[frame - 1]) * 60,
    ]
    assert torch.allclose(seen, torch.cat(expected), atol=2e-3)


def test_points_that_cannot_be_are_refused():
    with pytest.raises(WearcapError, match="the head, then"):
        TrackedPoints(("left_wrist",))
    with pytest.raises(WearcapError, match="no height 'ceiling'"):
        TrackedPoints(height="ceiling")
    assert TrackedPoints(HANDS).poses(xsens23(), Rigid.identity(2), torch.eye(3).expand(2, 23, 3, 3)).t.shape == (
        2,
        3,
        3,
    )
