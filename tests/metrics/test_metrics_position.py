"""Metrics of position and rotation against loops in plain Python and against known answers."""

import math

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.metrics import position


@pytest.fixture
def joints():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, 7, 5, 3, generator=generator, dtype=torch.float64)


def distance(a, b) -> float:
    return math.sqrt(sum((x - y) ** 2 for x, y in zip(a.tolist(), b.tolist())))


def test_mpjpe_agrees_with_loops(joints):
    found, true = joints
    errors = [distance(found[t, j], true[t, j]) for t in range(7) for j in range(5)]
    assert position.mpjpe_cm(found, true).item() == pytest.approx(100 * sum(errors) / 35)
    assert position.joint_error_cm(found, true)[2, 3].item() == pytest.approx(100 * errors[2 * 5 + 3])


def test_mpjpe_of_a_shift_is_its_length():
    true = torch.rand(4, 23, 3)
    assert position.mpjpe_cm(true + torch.tensor([0.03, 0.0, 0.04]), true).item() == pytest.approx(5, rel=1e-4)


def test_mpjve_agrees_with_loops_and_ignores_a_constant_shift(joints):
    found, true = joints
    fps = 30.0
    errors = []
    for t in range(1, 7):
        for j in range(5):
            velocity = (found[t, j] - found[t - 1, j]) * fps
            errors.append(distance(velocity, (true[t, j] - true[t - 1, j]) * fps))
    assert position.mpjve_cm_s(found, true, fps).item() == pytest.approx(100 * sum(errors) / len(errors))
    assert position.mpjve_cm_s(true + 1, true, fps).item() == pytest.approx(0, abs=1e-9)


def test_percentile_takes_whole_frames():
    true = torch.zeros(101, 2, 3)
    found = true.clone()
    found[:, 0, 2] = torch.arange(101) / 100.0  # the other joint is right: frame errors 0, 0.5, … 50 cm
    assert position.error_percentile_cm(position.joint_error_cm(found, true).mean(-1)).item() == pytest.approx(47.5)
    assert position.error_percentile_cm(position.joint_error_cm(found, true).mean(-1), 50.0).item() == pytest.approx(25)


def test_root_error():
    true = torch.zeros(2, 3)
    found = torch.tensor([[0.0, 0.1, 0.0], [0.3, 0.0, 0.0]])
    assert position.root_error_cm(found, true).item() == pytest.approx(20)


def test_rotation_error_is_the_angle():
    R_true = rotation.exp(torch.randn(6, 4, 3, generator=torch.Generator().manual_seed(1)))
    R = R_true.clone()
    R[:, 0] = R_true[:, 0] @ rotation.about_axis("y", torch.tensor(math.radians(20)))
    assert position.rotation_error_deg(R.double(), R_true.double()).item() == pytest.approx(5, abs=0.01)


def test_body_parts_of_xsens():
    skeleton = xsens23()
    parts = {
        name: {skeleton.joint_names[joint] for joint in joints}
        for name, joints in position.body_parts(skeleton).items()
    }
    assert parts["hand"] == {"left_wrist", "right_wrist"}
    assert parts["lower"] == {f"{side}_{j}" for side in ("left", "right") for j in ("hip", "knee", "ankle", "toe")}
    assert parts["upper"] == set(skeleton.joint_names) - parts["lower"] - {"pelvis"}
    assert len(parts["upper"]) == 14


def test_body_parts_name_the_missing_joint():
    skeleton = xsens23()
    names = tuple(name.replace("left_wrist", "paw") for name in skeleton.joint_names)
    pawed = type(skeleton)("dog", names, skeleton.parents, skeleton.t_parent_joint)
    with pytest.raises(WearcapError, match="left_wrist"):
        position.body_parts(pawed)
