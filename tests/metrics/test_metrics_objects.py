"""ECHO's measures, each against itself written out in another way."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from walking_person import walk
from wearcap.geometry.rigid import Rigid
from wearcap.metrics.objects import (
    center_error_cm,
    foot_contact_share,
    joint_step_error_mm,
    quaternion_difference,
    rotation_difference_deg,
    vertex_error_cm,
)

VERTICES = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def poses() -> tuple[Rigid, Rigid, Rotation, Rotation]:
    rng = np.random.default_rng(0)
    spins = [Rotation.random(9, rng=rng) for _ in range(2)]
    t = torch.from_numpy(rng.normal(size=(2, 9, 3)))
    found, true = (Rigid(torch.from_numpy(spin.as_matrix()), place) for spin, place in zip(spins, t))
    return found, true, *spins


def test_vertices_and_centre_one_by_one(poses):
    found, true, one, two = poses
    vertices = VERTICES.double()
    v2v, center = vertex_error_cm(found, true, vertices), center_error_cm(found, true, vertices)
    for k in range(9):
        total, mean = 0.0, np.zeros(3)
        for vertex in vertices.numpy():
            here, there = (spin[k].apply(vertex) + T.t[k].numpy() for spin, T in ((one, found), (two, true)))
            total += math.dist(here, there)
            mean += (here - there) / len(vertices)
        assert v2v[k].item() == pytest.approx(100 * total / len(vertices))
        assert center[k].item() == pytest.approx(100 * np.linalg.norm(mean))
    assert (center <= v2v + 1e-9).all()


def test_rotations_are_scipys(poses):
    found, true, one, two = poses
    angle = np.rad2deg((one.inv() * two).magnitude())
    np.testing.assert_allclose(rotation_difference_deg(found, true).numpy(), angle, atol=1e-6)
    quats = [spin.as_quat(canonical=True, scalar_first=True) for spin in (one, two)]
    np.testing.assert_allclose(
        quaternion_difference(found, true).numpy(), np.abs(quats[0] - quats[1]).sum(1), atol=1e-6
    )


def test_nothing_is_lost_where_nothing_differs(poses):
    found, *_ = poses
    for measure in (rotation_difference_deg, quaternion_difference):
        assert measure(found, found).abs().max() < 1e-5
    assert vertex_error_cm(found, found, VERTICES.double()).max() == 0
    assert center_error_cm(found, found, VERTICES.double()).max() == 0


def test_steps_one_by_one():
    joints, true = torch.randn(2, 6, 5, 3, generator=torch.Generator().manual_seed(1)).unbind(0)
    total = 0.0
    for k in range(1, 6):
        for j in range(5):
            step, true_step = (at[k, j] - at[k - 1, j] for at in (joints, true))
            total += math.dist(step.tolist(), true_step.tolist()) / 25
    assert joint_step_error_mm(joints, true).item() == pytest.approx(1000 * total, rel=1e-5)
    assert joint_step_error_mm(true + 3.0, true).item() == pytest.approx(0.0, abs=1e-3)


def test_a_foot_is_down_where_one_of_its_joints_is_low():
    motion = walk(torch.arange(45, dtype=torch.float64) / 30)[0]
    joints, floor = motion.T_world_joint.t.clone(), torch.linspace(-0.06, 0.01, 45)
    joints[20:30, :, 2] += 0.4
    index = motion.skeleton.index
    down = [
        any(
            joints[k, index(f"{side}_{name}"), 2] - floor[k] < limit
            for side in ("left", "right")
            for name, limit in (("ankle", 0.1), ("toe", 0.05))
        )
        for k in range(45)
    ]
    assert 0 < sum(map(bool, down)) < 45
    share = foot_contact_share(motion.skeleton, joints, floor).item()
    assert share == pytest.approx(sum(map(bool, down)) / 45)
