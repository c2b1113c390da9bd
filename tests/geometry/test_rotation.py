"""Group axioms, round trips and gradients of rotations, at the identity and near π too."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wearcap.geometry import rotation

COORDINATE = st.floats(-1, 1, allow_nan=False)
ANGLES = st.one_of(
    st.floats(0, math.pi - 1e-6), st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 1e-3, math.pi - 1e-3, math.pi - 1e-5])
)


@st.composite
def rotvecs(draw) -> torch.Tensor:
    axis = torch.tensor([draw(COORDINATE) for _ in range(3)], dtype=torch.float64)
    if axis.norm() < 1e-3:
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return axis / axis.norm() * draw(ANGLES)


def random_rotations(*batch: int, seed: int = 0, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(*batch, 4, generator=generator, dtype=dtype)
    return rotation.matrix_from_quat_wxyz(quat)


@settings(max_examples=60, deadline=None)
@given(rotvecs(), rotvecs(), rotvecs())
def test_group_axioms(a, b, c):
    A, B, C = rotation.exp(a), rotation.exp(b), rotation.exp(c)
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(A @ A.mT, eye, atol=1e-12)
    assert torch.linalg.det(A @ B).item() == pytest.approx(1.0, abs=1e-12)
    assert torch.allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    assert torch.allclose(rotation.exp(-a) @ A, eye, atol=1e-12)
    assert torch.allclose((A @ B).mT, B.mT @ A.mT, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(rotvecs())
def test_exp_log_round_trip(rotvec):
    R = rotation.exp(rotvec)
    assert torch.allclose(R, torch.from_numpy(Rotation.from_rotvec(rotvec.numpy()).as_matrix()), atol=1e-12)
    assert torch.allclose(rotation.log(R), rotvec, atol=1e-7)


@settings(max_examples=60, deadline=None)
@given(rotvecs())
def test_encodings_round_trip(rotvec):
    R = rotation.exp(rotvec)
    assert torch.allclose(rotation.matrix_from_rot6d(rotation.rot6d_from_matrix(R)), R, atol=1e-12)
    quat = rotation.quat_wxyz_from_matrix(R)
    assert quat[0] >= 0
    assert quat.norm().item() == pytest.approx(1.0, abs=1e-12)
    assert torch.allclose(rotation.matrix_from_quat_wxyz(quat), R, atol=1e-12)
    # a quaternion's scale and sign mean nothing
    assert torch.allclose(rotation.matrix_from_quat_wxyz(-3 * quat), R, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(rotvecs(), rotvecs())
def test_geodesic_is_a_bi_invariant_distance(a, b):
    A, B = rotation.exp(a), rotation.exp(b)
    distance = rotation.geodesic(A, B)
    assert 0 <= distance <= math.pi + 1e-9
    assert torch.allclose(distance, rotation.geodesic(B, A), atol=1e-12)
    assert torch.allclose(distance, rotation.geodesic(B @ A, B @ B), atol=1e-12)
    assert torch.allclose(rotation.geodesic(A, torch.eye(3, dtype=torch.float64)), a.norm(), atol=1e-12)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3, 4), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_and_dtypes(batch, dtype):
    R = random_rotations(*batch, dtype=dtype)
    for value, shape in (
        (rotation.log(R), (*batch, 3)),
        (rotation.exp(rotation.log(R)), (*batch, 3, 3)),
        (rotation.rot6d_from_matrix(R), (*batch, 6)),
        (rotation.quat_wxyz_from_matrix(R), (*batch, 4)),
        (rotation.geodesic(R, R), batch),
        (rotation.yaw_of(R), batch),
    ):
        assert value.shape == shape
        assert value.dtype == dtype
        assert value.isfinite().all()


AXES = torch.nn.functional.normalize(
    torch.tensor([[1.0, 0, 0], [0, 0, -1], [1, 2, 3], [-1, 0.1, 0.5]], dtype=torch.float64), dim=-1
)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 1.0, math.pi - 1e-2, math.pi - 1e-4])
def test_gradients_in_float64(angle):
    rotvec = (AXES * angle).requires_grad_()
    assert torch.autograd.gradcheck(rotation.exp, rotvec, atol=1e-5)
    assert torch.autograd.gradcheck(lambda v: rotation.log(rotation.exp(v)), rotvec, eps=1e-7, atol=1e-4)
    R = rotation.exp(rotvec.detach())
    rot6d = rotation.rot6d_from_matrix(R).requires_grad_()
    assert torch.autograd.gradcheck(rotation.matrix_from_rot6d, rot6d)
    turn = lambda v: rotation.quat_wxyz_from_matrix(rotation.exp(v))  # noqa: E731
    assert torch.autograd.gradcheck(turn, rotvec, eps=1e-7, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_stay_finite_at_identity_and_pi(dtype):
    eye = torch.eye(3, dtype=dtype)
    for turn in (torch.zeros(3, dtype=dtype), torch.tensor([0, math.pi, 0], dtype=dtype)):
        R = rotation.exp(turn).requires_grad_()
        for value in (rotation.geodesic(R, eye), rotation.log(R).sum(), rotation.quat_wxyz_from_matrix(R).sum()):
            (gradient,) = torch.autograd.grad(value, R)
            assert gradient.isfinite().all()


def test_about_axis_agrees_with_exp():
    angle = torch.linspace(-4, 4, 9, dtype=torch.float64)
    for axis, name in zip(torch.eye(3, dtype=torch.float64), "xyz"):
        assert torch.allclose(rotation.about_axis(name, angle), rotation.exp(axis * angle[:, None]), atol=1e-12)


def test_rot6d_is_the_first_two_columns():
    R = random_rotations(4)
    assert torch.equal(rotation.rot6d_from_matrix(R), torch.cat([R[..., 0], R[..., 1]], -1))
    raw = torch.randn(7, 6, dtype=torch.float64)
    made = rotation.matrix_from_rot6d(raw)
    assert torch.allclose(made @ made.mT, torch.eye(3, dtype=torch.float64).expand(7, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(made), torch.ones(7, dtype=torch.float64))


@pytest.mark.parametrize("pitch_deg", [-89, -60, 0, 30, 64, 70, 89])
def test_yaw_keeps_its_heading_when_the_head_bends(pitch_deg):
    yaw = torch.linspace(-3, 3, 13, dtype=torch.float64)
    pitch = torch.full_like(yaw, math.radians(pitch_deg))
    R = rotation.about_axis("z", yaw) @ rotation.about_axis("y", pitch)
    assert torch.allclose(rotation.yaw_of(R), yaw, atol=1e-9)


def test_wrap_angle():
    angle = torch.tensor([0.0, math.pi, -math.pi, 7.0, -7.0], dtype=torch.float64)
    wrapped = rotation.wrap_angle(angle)
    assert ((wrapped >= -math.pi) & (wrapped < math.pi)).all()
    assert torch.allclose(wrapped.cos(), angle.cos())
    assert torch.allclose(wrapped.sin(), angle.sin(), atol=1e-12)


def test_mean_rotation_of_a_symmetric_fan_is_its_middle():
    middle = random_rotations()
    fan = middle @ rotation.exp(torch.tensor([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.2, 0], [0, -0.2, 0]]).double())
    assert torch.allclose(rotation.mean_rotation(fan), middle, atol=1e-12)
