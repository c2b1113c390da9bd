"""Metrics of plausibility against loops in plain Python and against known answers."""

import math

import pytest
import torch

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.metrics import physics


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def norm(vector) -> float:
    return math.sqrt(sum(x * x for x in vector))


def test_jitter_of_a_cubic_is_its_third_derivative():
    fps = 50.0
    t = torch.arange(40, dtype=torch.float64) / fps
    joints = torch.stack([t**3, 2 * t**2, -t], -1)[:, None].expand(40, 3, 3)
    assert physics.jitter_m_s3(joints, fps).item() == pytest.approx(6.0, rel=1e-6)


def test_jitter_agrees_with_loops():
    joints, fps = randn(9, 4, 3), 30.0
    lengths = []
    for t in range(6):
        for j in range(4):
            third = [
                (joints[t + 3, j, k] - 3 * joints[t + 2, j, k] + 3 * joints[t + 1, j, k] - joints[t, j, k]).item()
                for k in range(3)
            ]
            lengths.append(norm(third) * fps**3)
    assert physics.jitter_m_s3(joints, fps).item() == pytest.approx(sum(lengths) / len(lengths))


def test_too_short_for_jitter_is_nan():
    assert physics.jitter_m_s3(torch.zeros(3, 2, 3), 60.0).isnan()


def test_foot_points_are_heels_and_toe_tips_left_first():
    skeleton = xsens23()
    R = torch.eye(3).expand(2, 23, 3, 3)
    pose = forward_kinematics(skeleton, R, torch.zeros(2, 3))
    points = physics.foot_points(skeleton, pose)
    for foot, side in enumerate(("left", "right")):
        for point, site in enumerate(("heel", "toe_tip")):
            expected = skeleton.rest_sites[f"{side}_{site}"]
            torch.testing.assert_close(points[1, foot, point], expected)
    joints = physics.foot_joints(skeleton, pose)
    torch.testing.assert_close(joints[0, 1, 1], skeleton.rest_joints[skeleton.index("right_toe")])


def skate_by_loops(points, contact, fps) -> float:
    speeds = []
    for t in range(1, len(points)):
        for foot in range(2):
            if not (contact[t, foot] and contact[t - 1, foot]):
                continue
            point = 0 if points[t, foot, 0, 2] <= points[t, foot, 1, 2] else 1
            step = points[t, foot, point, :2] - points[t - 1, foot, point, :2]
            speeds.append(norm(step.tolist()) * fps * 100)
    return sum(speeds) / len(speeds)


def test_foot_skate_agrees_with_loops():
    points = randn(30, 2, 2, 3)
    contact = randn(30, 2, seed=1) > -0.3
    expected = skate_by_loops(points, contact, 60.0)
    assert physics.foot_skate_cm_s(points, contact, 60.0).item() == pytest.approx(expected)


def test_foot_skate_of_a_sliding_foot_and_of_none():
    points = torch.zeros(10, 2, 2, 3)
    points[:, 0, :, 0] = torch.arange(10)[:, None] * 0.01  # the left foot slides 1 cm per frame
    points[:, 0, 1, 2] = 0.1
    left = torch.tensor([True, False]).expand(10, 2)
    assert physics.foot_skate_cm_s(points, left, 60.0).item() == pytest.approx(60, rel=1e-4)
    assert physics.foot_skate_cm_s(points, left.flip(-1), 60.0).item() == 0
    assert physics.foot_skate_cm_s(points, torch.zeros(10, 2, dtype=torch.bool), 60.0).isnan()


def test_contact_needs_height_and_rest():
    points = torch.zeros(4, 2, 2, 3)
    points[..., 2] += 0.2
    points[:, 0, 1, 2] = 0.03  # left toe tip is low and still
    points[:, 1, 0, 2] = 0.03  # right heel is low, but moves 1 m/s
    points[:, 1, 0, 0] = torch.arange(4) / 60.0
    contact = physics.contact_from_motion(points, torch.zeros(4), 60.0)
    assert contact[1:].tolist() == [[True, False]] * 3
    assert not physics.contact_from_motion(points, torch.full((4,), -1.0), 60.0).any()


def test_foot_contact_joins_patches():
    contact = torch.tensor([[True, False, False, False], [False, False, False, True], [False] * 4])
    assert physics.foot_contact(contact).tolist() == [[True, False], [False, True], [False, False]]


def physicality_by_loops(root, feet, fps) -> float:
    scores, sizes = [], []
    for t in range(len(root) - 2):
        acceleration = [((root[t + 2, k] - 2 * root[t + 1, k] + root[t, k]) * fps**2).item() for k in range(3)]
        acceleration[2] = max(acceleration[2], 0.0)
        slower = [
            min(norm(((feet[t + 2, f, p] - feet[t + 1, f, p]) * fps).tolist()) for p in range(2)) for f in range(2)
        ]
        sizes.append(norm(acceleration))
        scores.append(norm(acceleration) * slower[0] * slower[1])
    return sum(scores) / len(scores) / max(sizes)


def test_physicality_agrees_with_loops():
    root, feet = randn(20, 3), randn(20, 2, 2, 3, seed=3)
    expected = physicality_by_loops(root, feet, 30.0)
    assert physics.physicality(root, feet, 30.0).item() == pytest.approx(expected)


def test_physicality_forgives_a_planted_foot_and_free_fall():
    fps, t = 60.0, torch.arange(60, dtype=torch.float64) / 60.0
    root = torch.stack([t**2, 0 * t, 0 * t], -1)
    moving = torch.stack([t, 0 * t, 0 * t], -1)[:, None, None].expand(60, 2, 2, 3).clone()
    assert physics.physicality(root, moving, fps).item() == pytest.approx(1.0, rel=1e-6)
    planted = moving.clone()
    planted[:, 1, 1] = 0  # the right toe stands: no push is unexplained
    assert physics.physicality(root, planted, fps).item() == 0
    falling = torch.stack([0 * t, 0 * t, -4.9 * t**2], -1)
    assert physics.physicality(falling, moving, fps).item() == pytest.approx(0, abs=1e-9)
    assert physics.physicality(root[:2], moving[:2], fps).isnan()


def test_local_floor_agrees_with_loops():
    joints, fps, window = randn(50, 3, 3), 10.0, 1.2
    floor = physics.local_floor(joints, fps, window)
    for t in range(50):
        near = range(max(0, t - 12), min(50, t + 13))
        assert floor[t].item() == min(joints[s, j, 2].item() for s in near for j in range(3))


def test_local_floor_of_a_recording_shorter_than_its_window():
    joints = randn(5, 2, 3)
    assert physics.local_floor(joints, 60.0).tolist() == [joints[..., 2].min().item()] * 5


def test_floor_penetration_is_the_depth_of_the_lowest_joint():
    joints = torch.ones(4, 2, 3)
    joints[0, 1, 2], joints[1, 0, 2] = -0.10, -0.02
    assert physics.floor_penetration_cm(joints, torch.zeros(4)).item() == pytest.approx(3.0)


def test_standing_still_on_float32_has_no_jitter_far_from_the_origin():
    skeleton = xsens23()
    R = rotation.exp(randn(1, 23, 3) * 0.3).expand(50, 23, 3, 3)
    pose = forward_kinematics(skeleton, R, torch.full((50, 3), 100.0, dtype=torch.float64))
    assert physics.jitter_m_s3(pose.t, 60.0).item() == pytest.approx(0, abs=1e-6)
