"""Hips that a motion capture system put wrong are found from how knees bend, and moved; feet and trunk stay."""

import math

import pytest
import torch

from data_prep.shared.hips import STRAIGHTEST_DEG, find_shift, with_shift
from wearcap.body.skeleton import xsens23
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import POINTS, knee_cycles, knee_deg, normal_knee_deg
from wearcap.recording.motion import Motion

FAULT = torch.tensor([0.012, -0.015], dtype=torch.float64)


def walk(seconds: float = 12.0, fps: float = 60) -> Motion:
    """A body that glides along x, legs swinging under it by 20°, knees after the normal curve but never below 5°."""
    times, skeleton = torch.arange(round(seconds * fps), dtype=torch.float64) / fps, xsens23()
    R = torch.eye(3).repeat(len(times), len(skeleton), 1, 1)
    curve = normal_knee_deg().double().clamp_min(5)
    for side, offset in (("left", 0.0), ("right", 0.5)):
        share = (times / 1.1 + offset) % 1.0
        low = (share * (POINTS - 1)).long().clamp(max=POINTS - 2)
        knee = curve[low] + (share * (POINTS - 1) - low) * (curve[low + 1] - curve[low])
        thigh = -20 * (2 * math.pi * (share - 0.27)).cos() - 0.1 * knee
        for name, angle in (("hip", thigh), ("knee", knee)):
            R[:, skeleton.index(f"{side}_{name}")] = about_axis("y", angle.deg2rad().float())
    t = torch.stack([1.2 * times, 0 * times, 0 * times + 0.92], -1).float()
    return Motion(times, skeleton, R, t)


def stand(bend_deg: float, seconds: float = 20.0) -> Motion:
    times, skeleton = torch.arange(round(30 * seconds), dtype=torch.float64) / 30, xsens23()
    R = torch.eye(3).repeat(len(times), len(skeleton), 1, 1)
    for side in ("left", "right"):
        for name, share in (("hip", -0.5), ("knee", 1.0), ("ankle", -0.5)):
            turn = about_axis("y", torch.tensor(math.radians(share * bend_deg)))
            R[:, skeleton.index(f"{side}_{name}")] = turn
    return Motion(times, skeleton, R, torch.zeros(len(times), 3))


def test_the_shift_is_found_and_undone():
    true = walk()
    wrong = with_shift(true, FAULT)
    assert knee_deg(wrong).mean() > knee_deg(true).mean() + 5
    found = find_shift([wrong], (-0.005, 0.005))
    assert (found + FAULT).abs().max() < 0.006
    right = with_shift(wrong, found)
    curves = torch.cat(knee_cycles(right)).mean(0)
    assert (curves - normal_knee_deg()).square().mean().sqrt() < 3
    assert right.provenance["hips_moved_m"].startswith(f"{found[0]:.4f}")


def test_feet_and_trunk_stay_and_knees_do_not_snap():
    true = walk()
    moved = with_shift(true, torch.tensor([-0.02, 0.03], dtype=torch.float64))
    for name in ("left_ankle", "right_ankle", "left_toe", "right_toe"):
        assert (moved.joint(name).t - true.joint(name).t).norm(dim=-1).max() < 1e-3
        assert torch.allclose(moved.joint(name).R, true.joint(name).R, atol=1e-4)
    nearer = moved.joint("l5").t - true.joint("l5").t  # legs that are too short bring the body nearer to the feet
    assert (moved.joint("head").t - true.joint("head").t - nearer).abs().max() < 1e-4
    assert nearer[:, 2].max() < 1e-3
    assert nearer.norm(dim=-1).max() < 0.04
    assert knee_deg(moved).min() > STRAIGHTEST_DEG - 1
    assert (moved.skeleton.t_parent_joint[1] - true.skeleton.t_parent_joint[1]).tolist() == pytest.approx(
        [0.02, 0, -0.03]
    )
    hips = moved.skeleton.indices("left_hip", "right_hip")
    assert torch.equal(moved.skeleton.t_parent_joint[hips], true.skeleton.t_parent_joint[hips])


def test_standing_people_show_their_hips_and_actors_do_not():
    usual = (-0.01, 0.01)
    bent = find_shift([stand(20.0)], usual)
    assert bent[1] > 0.012
    nobody = find_shift([stand(20.0, seconds=0.5)], usual)
    assert nobody.tolist() == pytest.approx(usual, abs=5e-4)
    squat = find_shift([stand(90.0)], usual)
    assert squat.tolist() == pytest.approx(usual, abs=4e-3)
