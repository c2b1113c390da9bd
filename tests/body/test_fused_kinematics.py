"""Fused forward kinematics: equal to the level version, its gradient to finite differences."""

import multiprocessing
import sys

import pytest
import torch

from wearcap.body import kinematics
from wearcap.body.kinematics import _can_fuse, forward_kinematics, level_forward_kinematics, local_rotations
from wearcap.body.skeletons import skeleton_by_name
from wearcap.geometry import rotation


def sample(skeleton, batch, dtype, per_sample_offsets=False):
    torch.manual_seed(len(batch))
    R = rotation.exp(torch.randn(*batch, len(skeleton), 3, dtype=dtype))
    offsets = skeleton.t_parent_joint.to(dtype)
    if per_sample_offsets:
        offsets = offsets * (0.8 + 0.4 * torch.rand(*batch, 1, 1, dtype=dtype))
    return R, torch.randn(*batch, 3, dtype=dtype), offsets


def fused(*inputs):
    T_world = forward_kinematics(*inputs)
    return T_world.R, T_world.t


@pytest.mark.parametrize("name", ["xsens23", "smplh52"])
@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("per_sample", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_the_level_version(name, batch, per_sample, dtype):
    skeleton = skeleton_by_name(name)
    R, t, offsets = sample(skeleton, batch, dtype, per_sample)
    R_world, t_world = fused(skeleton, R, t, offsets)
    level = level_forward_kinematics(skeleton, R, t, offsets)
    torch.testing.assert_close(R_world, level.R)
    torch.testing.assert_close(t_world, level.t)
    torch.testing.assert_close(local_rotations(skeleton, R_world), R, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("per_sample", [False, True])
def test_gradient_is_that_of_finite_differences(per_sample):
    skeleton = skeleton_by_name("xsens23")
    inputs = [x.requires_grad_() for x in sample(skeleton, (2,), torch.float64, per_sample)]
    assert torch.autograd.gradcheck(lambda *x: fused(skeleton, *x), inputs)


def test_gradient_equals_the_level_versions_for_strided_inputs():
    skeleton = skeleton_by_name("smpl24")
    R, t, offsets = sample(skeleton, (6,), torch.float64, True)
    seeds = torch.randn(6, 24, 3, 3, dtype=torch.float64), torch.randn(6, 24, 3, dtype=torch.float64)
    gradients = []
    for version in (fused, lambda *x: vars(level_forward_kinematics(*x)).values()):
        leaves = [x.transpose(0, -1).contiguous().transpose(0, -1).requires_grad_() for x in (R, t, offsets)]
        gradients.append(torch.autograd.grad(tuple(version(skeleton, *leaves)), leaves, seeds))
    for one, other in zip(*gradients):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("per_sample", [False, True])
def test_threads_share_the_work_exactly(per_sample, monkeypatch):
    monkeypatch.setattr(kinematics, "_WORTH_THREADS", 1)
    skeleton = skeleton_by_name("xsens23")
    inputs = sample(skeleton, (1501,), torch.float32, per_sample)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            leaves = [x.clone().requires_grad_() for x in inputs]
            R, t = fused(skeleton, *leaves)
            results.append((R, t, *torch.autograd.grad((R.square().sum() + t.square().sum()), leaves)))
    finally:
        torch.set_num_threads(threads)
    for one, three in zip(*results):
        torch.testing.assert_close(one, three, atol=0, rtol=1e-5)


def joints_in_threads(inputs, results):
    results.put(fused(*inputs)[1].sum().item())


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs fork")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    """Loader workers are forked after the parent has used its threads."""
    monkeypatch.setattr(kinematics, "_WORTH_THREADS", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    skeleton = skeleton_by_name("xsens23")
    inputs = skeleton, *sample(skeleton, (9,), torch.float64)
    expected = fused(*inputs)[1].sum().item()
    context = multiprocessing.get_context("fork")
    results = context.SimpleQueue()
    child = context.Process(target=joints_in_threads, args=(inputs, results))
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert results.get() == pytest.approx(expected)


def test_what_does_not_fit_is_refused():
    skeleton = skeleton_by_name("xsens23")
    R, t, offsets = sample(skeleton, (4,), torch.float32)
    for wrong in ((R[:, 1:], t, offsets), (R, t[:3], offsets), (R, t, offsets[1:])):
        with pytest.raises((RuntimeError, TypeError)):
            fused(skeleton, *wrong)


def test_unused_outputs_and_repeated_backward():
    """Only positions are used, the expanded gradient of a sum comes in, and a second backward gives the same."""
    skeleton = skeleton_by_name("xsens23")
    R, t, _ = sample(skeleton, (4,), torch.float32)
    R.requires_grad_()
    loss = forward_kinematics(skeleton, R, t).t.sum()
    first = torch.autograd.grad(loss, R, retain_graph=True)[0]
    torch.testing.assert_close(torch.autograd.grad(loss, R)[0], first)
    level = level_forward_kinematics(skeleton, R, t, skeleton.t_parent_joint).t.sum()
    torch.testing.assert_close(first, torch.autograd.grad(level, R)[0], atol=1e-5, rtol=1e-5)


def test_transforms_and_compilers_take_the_level_version():
    skeleton = skeleton_by_name("xsens23")
    R, t, _ = sample(skeleton, (3,), torch.float64)
    positions = lambda R, t: forward_kinematics(skeleton, R, t).t  # noqa: E731
    jacobian = torch.func.vmap(torch.func.jacrev(positions))(R, t)
    assert jacobian.shape == (3, 23, 3, 23, 3, 3)
    assert torch.func.jacfwd(positions)(R[0], t[0]).shape == (23, 3, 23, 3, 3)
    assert _can_fuse(R, t)
    assert not _can_fuse(R, t.float())
    assert not _can_fuse(R.to("meta"), t.to("meta"))

    class Positions(torch.nn.Module):
        def forward(self, R, t):
            return positions(R, t)

    exported = torch.export.export(Positions(), (R, t), strict=False)
    torch.testing.assert_close(exported.module()(R, t), positions(R, t))
    torch.testing.assert_close(positions(R, t), forward_kinematics(skeleton, R, t).t)


@pytest.mark.gpu
def test_cuda_agrees_with_the_cpu():
    skeleton = skeleton_by_name("xsens23")
    R, t, _ = sample(skeleton, (7,), torch.float32)
    device = forward_kinematics(skeleton, R.cuda(), t.cuda())
    torch.testing.assert_close(device.t.cpu(), forward_kinematics(skeleton, R, t).t, atol=1e-5, rtol=1e-5)
