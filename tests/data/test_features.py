"""Head features: invariances that the frames promise, and exact round trips."""

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.data.features import body_size
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.systems.hmd2.features import HeadFeatures

FPS = 60.0


def path(batch: int = 2, time: int = 20):
    torch.manual_seed(0)
    heading = rotation.about_axis("z", torch.linspace(0, 1.5, time).expand(batch, time))
    R = heading @ rotation.exp(0.2 * torch.randn(batch, time, 3))
    t = torch.cumsum(0.02 * torch.randn(batch, time, 3), 1) + torch.tensor([1.0, 2.0, 1.6])
    return R, t, torch.zeros(batch, time), torch.full((batch, 4), 1.6)


@pytest.mark.parametrize("frame", ["heading", "window"])
@pytest.mark.parametrize("height", ["stature", "floor", "relative"])
def test_condition_does_not_know_where_or_which_way_the_wearer_faces(frame, height):
    features = HeadFeatures(frame, height)
    R, t, floor, stature = path()
    turn, shift = rotation.about_axis("z", torch.tensor(2.1)), torch.tensor([5.0, -3.0, 0.7])
    moved = features.condition(turn @ R, (turn @ t[..., None])[..., 0] + shift, floor + 0.7, stature, FPS)
    assert moved.shape[-1] == features.condition_size
    assert torch.allclose(moved, features.condition(R, t, floor, stature, FPS), atol=2e-4)


def test_condition_keeps_gravity():
    features = HeadFeatures()
    R, t, floor, stature = path()
    tilt = rotation.about_axis("x", torch.tensor(0.3))
    assert not torch.allclose(
        features.condition(tilt @ R, t, floor, stature, FPS), features.condition(R, t, floor, stature, FPS), atol=0.05
    )


def test_velocities_are_per_second_and_in_the_heading():
    """Walking sideways to the left at 1.2 m/s while turning left at 0.5 rad/s."""
    time = torch.arange(30) / FPS
    yaw = 0.5 * time[None]
    R = rotation.about_axis("z", yaw)
    left = R[..., 1]
    t = torch.cumsum(1.2 / FPS * left, 1)
    condition = HeadFeatures(height="floor").condition(R, t, torch.zeros(1, 30), torch.ones(1, 4), FPS)
    assert torch.allclose(condition[0, 5:, 7:10], torch.tensor([0.0, 1.2, 0.0]), atol=0.02)
    assert torch.allclose(condition[0, 5:, 10:13], torch.tensor([0.0, 0.0, 0.5]), atol=1e-3)


@pytest.mark.parametrize("frame", ["heading", "window"])
def test_poses_round_trip(frame):
    features = HeadFeatures(frame)
    R_head, *_ = path()
    R = rotation.exp(torch.randn(2, 20, 23, 3))
    contact = torch.rand(2, 20, 2)
    motion = features.encode(R, R_head, contact)
    assert motion.shape[-1] == features.motion_size
    decoded, none = features.decode(motion, R_head)
    assert torch.allclose(decoded, R, atol=1e-5)
    assert not none.any()


def test_contacts_round_trip_and_are_probabilities():
    features = HeadFeatures(contacts=True)
    R_head, *_ = path()
    contact = torch.rand(2, 20, 2)
    motion = features.encode(rotation.exp(torch.randn(2, 20, 23, 3)), R_head, contact)
    assert motion.shape[-1] == features.motion_size == 140
    assert torch.allclose(features.decode(motion, R_head)[1], contact, atol=1e-6)
    assert features.decode(3 * motion, R_head)[1].amax() <= 1


def test_the_condition_tells_the_body_where_asked_to():
    R, t, floor, _ = path()
    size = body_size(xsens23()).expand(2, -1)
    plain, with_size = (HeadFeatures(body=body).condition(R, t, floor, size, FPS) for body in (False, True))
    assert torch.equal(with_size[..., : plain.shape[-1]], plain)
    assert torch.equal(with_size[0, 3, plain.shape[-1] :], size[0])
    assert 0.7 < size[0, 1] < 1.0
    assert size[0, 0] > size[0, 1] > size[0, 2] > 0.4


def test_unknown_choices_are_named():
    with pytest.raises(WearcapError, match="no frame 'wrold'"):
        HeadFeatures(frame="wrold")
