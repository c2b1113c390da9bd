"""Objects as conditions of ECHO, and contact of body points with them."""

import pytest
import torch

from carried_box import HALF, MIDDLE, box_mesh, scene_object, small_features
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.models.point_encoder import PointNeXt
from wearcap.systems.echo.observations import ObjectReader
from wearcap.systems.echo.scores import body_contact

POSE = Rigid(rotation.exp(torch.tensor([[0.3, -0.9, 0.4], [1.0, 0.2, 0.0]])), torch.tensor([[0.5, 2.0, 1.0], [0.0, 0.1, -0.3]]))  # fmt: skip


@pytest.fixture(scope="module")
def shape():
    return ObjectReader(small_features(), None)(scene_object("box_1"))


def distance_to_box(points: torch.Tensor) -> torch.Tensor:
    """From points to the surface of the box about the origin, without its mesh (m)."""
    beyond = points.abs() - torch.tensor(HALF, dtype=points.dtype)
    outside = beyond.clamp_min(0).norm(dim=-1)
    return torch.where(outside > 0, outside, -beyond.amax(-1))


def test_its_code_is_class_and_extents(shape):
    assert shape.code[:2].tolist() == [1.0, 0.0]
    torch.testing.assert_close(shape.code[2:5], torch.tensor(HALF).float(), atol=5e-3, rtol=0)
    torch.testing.assert_close(shape.middle, torch.tensor(MIDDLE).float(), atol=5e-3, rtol=0)
    torch.testing.assert_close(shape.code[5:], torch.zeros(3), atol=1e-6, rtol=0)
    assert len(shape.code) == small_features().object_condition_size


def test_its_feature_is_the_encoders_and_its_mirror_images(shape):
    torch.manual_seed(0)
    encoder = PointNeXt(4, (6,), (0,), (8,), 0.3).eval()
    reader = ObjectReader(small_features(shape_size=encoder.size), encoder)
    encoded = reader(scene_object("box_1"))
    assert len(encoded.code) == reader.features.object_condition_size
    torch.testing.assert_close(encoded.code[8:], encoder(encoded.cloud[None])[0], atol=1e-5, rtol=0)
    flipped = encoded.cloud * torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(encoded.code_mirrored[8:], encoder(flipped[None])[0], atol=1e-5, rtol=0)
    assert torch.equal(encoded.code[:2], encoded.code_mirrored[:2])
    assert not encoded.code.requires_grad


def test_a_mesh_is_read_once_for_all_objects_that_have_it():
    reader, mesh = ObjectReader(small_features(), None), box_mesh()
    one, two, chair = (
        reader(scene_object("a", mesh=mesh)),
        reader(scene_object("b", mesh=mesh)),
        reader(scene_object("c", "chair", mesh)),
    )
    assert one.surface is two.surface
    assert (one.name, two.name) == ("a", "b")
    assert not torch.equal(one.code, chair.code)


def test_middle_and_mesh_are_two_names_of_one_pose(shape):
    centred = shape.centred(POSE)
    torch.testing.assert_close(centred.t, POSE @ shape.middle)
    torch.testing.assert_close(shape.of_mesh(centred).matrix(), POSE.matrix())


@pytest.mark.parametrize("within_m", [0.02, 0.05])
def test_a_touch_is_a_distance_to_the_surface(shape, within_m):
    """Against the distance to a box as a formula, from outside and from within."""
    random = torch.Generator().manual_seed(0)
    local = 0.5 * torch.rand(2, 300, 3, generator=random).double() - 0.25
    exact = ObjectReader(small_features(), None)(scene_object("box_1"))
    T_world_mesh = Rigid(POSE.R.double(), POSE.t.double())
    world = T_world_mesh[:, None] @ (local + torch.tensor(MIDDLE))
    touches = body_contact(world.float(), exact, exact.centred(POSE), within_m)
    distance = distance_to_box(local)
    clear = (distance - within_m).abs() > 1e-5
    assert torch.equal(touches[clear], (distance <= within_m)[clear])
    assert 0.02 < touches.float().mean() < 0.9


def test_what_is_deep_inside_does_not_touch(shape):
    inside = (POSE @ torch.tensor(MIDDLE).float())[:, None]
    assert not body_contact(inside, shape, shape.centred(POSE), 0.04).any()
    assert body_contact(inside, shape, shape.centred(POSE), 0.06).all()


def test_an_unknown_class_is_named():
    with pytest.raises(WearcapError, match="no object class 'piano'. Expected one of box, chair"):
        ObjectReader(small_features(), None)(scene_object("p", "piano"))
