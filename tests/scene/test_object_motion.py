import math

import numpy as np
import pytest
import torch

from boxes import box_mesh
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Freedom, ObjectState, SceneObject, follow_hands

BOTH, LEFT, RIGHT = torch.tensor([True, True]), torch.tensor([True, False]), torch.tensor([False, True])


TRIANGLE = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.ones(3, np.float32))


def scene_object(freedom: Freedom, t=(1.0, 2.0, 0.0)) -> SceneObject:
    return SceneObject("a", "sofa", TRIANGLE, torch.eye(3), torch.tensor(t), freedom)


def held_points(T: Rigid, points: torch.Tensor) -> torch.Tensor:
    """Hands fixed on an object: "time hand 3"."""
    return torch.stack([T @ point for point in points], 1)


@pytest.mark.parametrize("anchor", ["right", "middle"])
def test_two_hands_turn_and_shift_an_object_in_the_plane(anchor):
    sofa = scene_object(Freedom("plane"))
    angle = torch.linspace(0, 4.0, 200).double()  # on through π
    t = torch.stack([1 + angle.sin(), 2 + angle, 0 * angle], -1)
    true = Rigid(rotation.about_axis("z", angle), t)
    palms = held_points(true, torch.tensor([[-0.4, 0.3, 0.7], [-0.4, -0.3, 0.7]]).double())
    found, _ = follow_hands(sofa, ObjectState(sofa.T_world_object), palms, BOTH, anchor)
    torch.testing.assert_close(found.t, true.t + torch.tensor([1.0, 2.0, 0.0]).double() - true.t[0])
    torch.testing.assert_close(found.R, true.R)


def test_one_hand_only_shifts_and_the_plane_keeps_its_height():
    sofa = scene_object(Freedom("plane"))
    palms = torch.zeros(50, 2, 3).double()
    palms[:, 0] = torch.linspace(0, 1, 50)[:, None].double() * torch.tensor([1.0, -2.0, 0.3]).double()
    found, _ = follow_hands(sofa, ObjectState(sofa.T_world_object), palms, LEFT)
    torch.testing.assert_close(found.t[-1], torch.tensor([2.0, 0.0, 0.0]).double())
    assert (torch.eye(3).double() == found.R).all()
    box = scene_object(Freedom("free"))
    lifted, _ = follow_hands(box, ObjectState(box.T_world_object), palms, LEFT)
    assert lifted.t[-1, 2].item() == pytest.approx(0.3)


def test_a_door_turns_about_its_hinge_continuously_and_within_its_limits():
    door = scene_object(Freedom("hinge", pivot=(1.0, 2.0, 0.0), limits=(0.0, 1.6)))
    start = 0.4
    angle = start + torch.linspace(0, 2.0, 300).double()
    palms = torch.zeros(300, 2, 3).double()
    direction = angle + 2.5  # the arm's direction passes ±π meanwhile
    palms[:, 1] = torch.stack([1 + 0.7 * direction.cos(), 2 + 0.7 * direction.sin(), 1 + 0 * angle], -1)
    found, value = follow_hands(
        door, ObjectState(door.freedom.moved(door.T_world_object, torch.tensor(start)), start), palms, RIGHT
    )
    torch.testing.assert_close(value, angle.clamp(max=1.6))
    assert value.diff().abs().max() < 0.01
    torch.testing.assert_close(found.R, rotation.about_axis("z", value))


def test_a_drawer_follows_its_axis_alone():
    axis = (math.cos(0.3), math.sin(0.3), 0.0)
    drawer = scene_object(Freedom("axis", axis=axis, limits=(0.0, 0.4)))
    palms = torch.zeros(60, 2, 3).double()
    displacement = torch.linspace(0, 0.6, 60).double()
    palms[:, 1] = (
        displacement[:, None] * torch.tensor(axis).double()
        + torch.tensor([0.0, 0.0, 0.05]) * displacement[:, None].sin()
    )
    found, value = follow_hands(drawer, ObjectState(drawer.T_world_object), palms, RIGHT)
    torch.testing.assert_close(value, displacement.clamp(max=0.4))
    torch.testing.assert_close(found.t[-1], torch.tensor([1.0, 2.0, 0.0]).double() + 0.4 * torch.tensor(axis).double())


def test_hands_that_meet_keep_the_last_angle():
    sofa = scene_object(Freedom("plane"))
    apart = torch.cat([torch.linspace(0.5, 0.0, 40), torch.zeros(5), torch.linspace(0.0, 0.5, 40)]).double()
    palms = torch.zeros(85, 2, 3).double()
    palms[:, 0, 0], palms[:, 1, 0] = apart / 2, -apart / 2
    found, _ = follow_hands(sofa, ObjectState(sofa.T_world_object), palms, BOTH)
    assert np.isfinite(found.R.numpy()).all()
    torch.testing.assert_close(found.R, torch.eye(3).double().expand(85, 3, 3))


def test_hands_that_begin_together_turn_nothing_until_they_part():
    sofa = scene_object(Freedom("plane"))
    apart = torch.linspace(0.0, 0.5, 60).double()
    palms = torch.zeros(60, 2, 3).double()
    palms[:, 0, 1], palms[:, 1, 1] = apart / 2, -apart / 2  # along y: not the direction of any default
    found, _ = follow_hands(sofa, ObjectState(sofa.T_world_object), palms, BOTH)
    torch.testing.assert_close(found.R, torch.eye(3).double().expand(60, 3, 3))


def test_a_pose_is_brought_to_what_the_objects_freedom_allows():
    """Poses that are allowed stay; others come back to them: the hinge's angle, the axis, the floor, up to the limits."""
    random = torch.Generator().manual_seed(0)
    middle, start = (
        torch.tensor([0.4, 0.0, 1.0]),
        Rigid(rotation.about_axis("z", torch.tensor(0.3)), torch.tensor([1.0, 2.0, 0.1])),
    )
    tilt = rotation.exp(0.2 * torch.randn(5, 3, generator=random))
    for freedom in (
        Freedom("hinge", pivot=(1.0, 2.0, 0.0), limits=(0.0, 1.2)),
        Freedom("axis", axis=(0.6, 0.8, 0.0), limits=(0.0, 0.5)),
        Freedom("plane"),
        Freedom("free"),
    ):
        item = SceneObject("thing", "box", box_mesh((0.0, -0.1, 0.0), (0.8, 0.1, 2.0)), start.R, start.t, freedom)
        value = torch.tensor([0.0, 0.1, 0.3, 0.4, 0.5])
        if freedom.kind in ("hinge", "axis"):
            allowed = freedom.moved(start, value)
        else:
            R = rotation.about_axis("z", 3 * value) @ start.R
            allowed = Rigid(R, start.t + value[:, None] * torch.tensor([1.0, -2.0, 0.0]))
        same = item.reachable(allowed, middle)
        torch.testing.assert_close(same.R, allowed.R, atol=1e-5, rtol=0)
        torch.testing.assert_close(same.t, allowed.t, atol=1e-5, rtol=0)
        # Tilted about its middle, and lifted: neither is to be seen in what the object can do.
        at = allowed @ middle
        away = Rigid(
            tilt @ allowed.R, at - (tilt @ allowed.R @ middle[:, None])[..., 0] + torch.tensor([0.0, 0.0, 0.2])
        )
        back = item.reachable(away, middle)
        if freedom.kind == "free":
            assert torch.equal(back.R, away.R)
            continue
        assert (back.R @ start.R.mT)[:, 2, 2].min() > 1 - 1e-5, "upright"
        error = (back @ middle - at).norm(dim=-1)
        assert error.max() < 0.02, freedom.kind
        if freedom.limits is not None:
            beyond = item.reachable(
                freedom.moved(start, torch.tensor([-0.7, 2.0 if freedom.kind == "hinge" else 9.0])), middle
            )
            ends = freedom.moved(start, torch.tensor(freedom.limits))
            torch.testing.assert_close(beyond.R, ends.R, atol=1e-5, rtol=0)
            torch.testing.assert_close(beyond.t, ends.t, atol=1e-5, rtol=0)
