"""SE(3): group axioms, batches, round trips."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid

SEEDS = st.integers(0, 10_000)


def random_rigid(seed: int, *batch: int) -> Rigid:
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(*batch, 4, generator=generator, dtype=torch.float64)
    t = 5 * torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    return Rigid(rotation.matrix_from_quat_wxyz(quat), t)


def same(a: Rigid, b: Rigid) -> bool:
    return torch.allclose(a.R, b.R, atol=1e-10) and torch.allclose(a.t, b.t, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(SEEDS)
def test_group_axioms(seed):
    a, b, c = (random_rigid(3 * seed + i) for i in range(3))
    identity = Rigid.identity(dtype=torch.float64)
    assert same((a @ b) @ c, a @ (b @ c))
    assert same(a @ identity, a)
    assert same(identity @ a, a)
    assert same(a @ a.inverse(), identity)
    assert same(a.inverse() @ a, identity)
    assert same((a @ b).inverse(), b.inverse() @ a.inverse())
    point = torch.randn(3, dtype=torch.float64)
    assert torch.allclose((a @ b) @ point, a @ (b @ point), atol=1e-9)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_agrees_with_homogeneous_matrices(batch):
    a, b = random_rigid(1, *batch), random_rigid(2, *batch)
    assert torch.allclose((a @ b).matrix(), a.matrix() @ b.matrix())
    assert torch.allclose(a.inverse().matrix(), torch.linalg.inv(a.matrix()))
    assert same(Rigid.from_matrix(a.matrix()), a)


def test_a_cloud_broadcasts_against_a_batch_of_poses():
    T = random_rigid(3, 5)
    cloud = torch.randn(7, 3, dtype=torch.float64)
    moved = T[:, None] @ cloud
    assert moved.shape == (5, 7, 3)
    assert torch.allclose(moved[2, 4], T[2] @ cloud[4])


def test_inner_names_meet_when_chained():
    T_world_head, T_head_cam = random_rigid(4), random_rigid(5)
    point_cam = torch.randn(3, dtype=torch.float64)
    T_world_cam = T_world_head @ T_head_cam
    assert torch.allclose(T_world_cam @ point_cam, T_world_head @ (T_head_cam @ point_cam))


def test_gradients():
    T = random_rigid(6, 2)
    points = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    R, t = T.R.clone().requires_grad_(), T.t.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda R, t, p: Rigid(R, t) @ p, (R, t, points))
    assert torch.autograd.gradcheck(lambda R, t, p: Rigid(R, t).inverse() @ p, (R, t, points))
