"""Hands that come into view and leave it: in training windows, at the frames of a capture, and as features."""

import dataclasses

import pytest
import torch

from wearcap.data.batch import Batch
from wearcap.data.draws import Draws
from wearcap.data.packing import Packed, Track, joined
from wearcap.data.surroundings import HAND, hand_features
from wearcap.data.view import HandsInView
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.tracking.wrists import UNSEEN_S, seen_wrist

COUNT, FRAMES, FPS = 400, 60, 30.0
ALWAYS = {"everywhere": 0.0, "absent": 0.0, "least": 1.0, "down_deg": (0.0, 0.0)}


def batch() -> Batch:
    track = Packed(*joined([Track({"floor_height": torch.zeros(FRAMES)})], ["r0"]))
    none = torch.zeros(COUNT, dtype=torch.long)
    return Batch(track, Draws(torch.arange(COUNT)), none, none, FRAMES, FPS)


def seen(view: HandsInView, *places: tuple[float, float, float], yaw: float = 0.0) -> torch.Tensor:
    """Where hands at places (m) in the head's axes are found."""
    R = rotation.about_axis("z", torch.full((COUNT, FRAMES), yaw))
    t = torch.tensor([3.0, -2.0, 1.6]).expand(COUNT, FRAMES, 3)
    at = t[:, :, None] + (R[:, :, None] @ torch.tensor(places)[..., None])[..., 0]
    return view(Rigid(R, t), at, batch())


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_hand_inside_the_field_of_view_is_found_and_one_beside_it_is_not(yaw):
    view = HandsInView(**ALWAYS, across_deg=(40.0, 40.0), upright_deg=(30.0, 30.0))
    ahead, aside = torch.tensor([39.0, 41.0]).deg2rad().tan().tolist()
    assert seen(view, (1.0, ahead, 0.0), (1.0, aside, 0.0), yaw=yaw).all(0).all(0).tolist() == [True, False]
    high, higher = torch.tensor([29.0, 31.0]).deg2rad().tan().tolist()
    assert seen(view, (1.0, 0.0, -high), (1.0, 0.0, higher), yaw=yaw).any(0).any(0).tolist() == [True, False]
    down = dataclasses.replace(view, down_deg=(20.0, 20.0))
    assert not seen(down, (1.0, 0.0, high), (1.0, 0.0, high)).any()
    assert not seen(view, (-1.0, 0.0, 0.0), (-1.0, 0.1, 0.0)).any(), "behind"


def test_shares_of_windows_and_hands_are_as_given():
    everywhere = seen(dataclasses.replace(HandsInView(**ALWAYS), everywhere=0.3), (-1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    assert everywhere.all(1).all(1).float().mean() == pytest.approx(0.3, abs=0.07)
    absent = seen(HandsInView(**ALWAYS | {"absent": 0.2}), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert torch.equal(absent.any(1), absent.all(1))
    assert absent.float().mean() == pytest.approx(0.8, abs=0.05)


def test_bursts_are_as_long_and_as_frequent_as_given():
    """Each stretch of equal length is found with a chance that windows draw from a half to 1: three in four of them."""
    view = HandsInView(**ALWAYS | {"least": 0.5}, burst_s=(0.2, 0.2))
    found = seen(view, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert found.float().mean() == pytest.approx(0.75, abs=0.03)
    changes = (found[:, 1:] != found[:, :-1]).nonzero()
    together = changes[1:][(changes.diff(dim=0)[:, [0, 2]] == 0).all(1)]
    steps = changes.diff(dim=0)[(changes.diff(dim=0)[:, [0, 2]] == 0).all(1), 1]
    assert len(together) > 100
    assert (steps % 6).float().eq(0).float().mean() > 0.9, "stretches of 6 frames"


def test_a_wrist_counts_as_seen_near_its_poses_alone():
    times = torch.tensor([1.0, 1.1, 1.2, 2.0], dtype=torch.float64)
    path = torch.stack([times, 0 * times, 0 * times], 1).float()
    track = Trajectory(times, torch.eye(3).repeat(4, 1, 1), path)
    at = torch.tensor(
        [0.9, 1.0, 1.1499, 1.19 + UNSEEN_S, 1.21 + UNSEEN_S, 2.0, 1.99 + UNSEEN_S, 2.3], dtype=torch.float64
    )
    pose, there = seen_wrist(track, at)
    assert there.tolist() == [False, True, True, True, False, True, True, False]
    assert pose.t[there, 0].tolist() == pytest.approx([1.0, 1.1499, 1.2, 2.0, 2.0]), (
        "interpolated, or where it was last"
    )
    for nothing in (None, track[:0]):
        pose, there = seen_wrist(nothing, at)
        assert not there.any()
        assert torch.equal(pose.R, torch.eye(3).expand(8, 3, 3))
    single = seen_wrist(track[:1], at)[1]
    assert single.tolist() == [False, True, True, False, False, False, False, False]


def test_features_of_a_hand_are_its_pose_from_the_head_along_its_heading():
    head = Rigid(rotation.about_axis("z", torch.tensor([0.5, 0.5])), torch.tensor([[1.0, 2.0, 1.6]] * 2))
    own = Rigid(rotation.exp(torch.randn(2, 2, 3)), torch.randn(2, 2, 3))
    wrists = Rigid(head.R[:, None] @ own.R, head.t[:, None] + (head.R[:, None] @ own.t[..., None])[..., 0])
    there = torch.tensor([[True, False], [True, True]])
    features = hand_features(head, wrists, there).unflatten(-1, (2, HAND))
    torch.testing.assert_close(features[..., 1:4], torch.where(there[..., None], own.t, 0.0), atol=1e-5, rtol=0)
    six = torch.where(there[..., None], rotation.rot6d_from_matrix(own.R), 0.0)
    torch.testing.assert_close(features[..., 4:], six, atol=1e-5, rtol=0)
    assert torch.equal(features[..., 0], there.float())
    nod = Rigid(head.R @ rotation.about_axis("y", torch.tensor([0.4, 0.4])), head.t)
    torch.testing.assert_close(hand_features(nod, wrists, there), features.flatten(1), atol=1e-5, rtol=0)
