"""Contact points: on the surface, as many on the left as on the right, and the same for everyone."""

from dataclasses import replace

import pytest
import torch

from walking_person import walk
from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, HAND_POINTS, _in_t_pose, contact_points, mirrored_points
from wearcap.body.skeleton import xsens23
from wearcap.body.skeletons import skeleton_by_name

SKELETON = xsens23()


def rows_of(body, points) -> list[int]:
    """Vertices of a body that its points are."""
    distance = torch.cdist(points.rest_vertices.double(), body.rest_vertices.double())
    assert distance.min(1).values.max() < 1e-6
    return distance.argmin(1).tolist()


@pytest.fixture(scope="module")
def points():
    return contact_points(anny_body(SKELETON))


def test_there_are_64_and_all_are_different(points):
    assert len(points.rest_vertices) == BODY_POINTS == 64
    assert len(set(rows_of(anny_body(SKELETON), points))) == BODY_POINTS


def test_twins_are_each_others_and_mirror_images(points):
    twins = mirrored_points()
    assert torch.equal(twins[twins], torch.arange(BODY_POINTS))
    at = _in_t_pose(points)
    flipped = at[twins] * torch.tensor([1.0, -1.0, 1.0])
    assert (flipped - at).norm(dim=-1).max() < 0.04
    assert (at[: BODY_POINTS // 2, 1] > 0).all(), "the left half comes first"


def test_hands_have_points_of_their_own(points):
    first = torch.arange(HAND_POINTS)
    hands = {"left": first, "right": first + BODY_POINTS // 2}
    for side, rows in hands.items():
        assert len(rows) == HAND_POINTS
        wrist = SKELETON.index(f"{side}_wrist")
        assert (points.skin_joints[rows, 0] == wrist).all()
    assert torch.equal(mirrored_points()[hands["left"]], hands["right"])


def test_points_are_spread_over_the_body(points):
    at = _in_t_pose(points)
    hand = torch.arange(HAND_POINTS)
    rest = torch.arange(len(hand), BODY_POINTS // 2)
    for rows, least in ((hand, 0.02), (rest, 0.1)):
        assert torch.pdist(at[rows]).min() > least
    surface = _in_t_pose(anny_body(SKELETON))
    assert torch.cdist(surface, at).min(1).values.max() < 0.25, "nobody's skin is far from all points"


@pytest.mark.parametrize("who", [{"weight": 95.0}, {"gender": 1.0, "weight": 50.0}])
def test_other_people_have_the_same_points(points, who):
    other = anny_body(SKELETON, who)
    assert rows_of(other, contact_points(other)) == rows_of(anny_body(SKELETON), points)


def test_points_follow_the_surface(points):
    body = anny_body(SKELETON)
    pose = walk(torch.linspace(0, 1, 4, dtype=torch.float64))[0].T_world_joint
    rows = rows_of(body, points)
    torch.testing.assert_close(points.vertices(pose), body.vertices(pose)[:, rows], atol=1e-5, rtol=0)


def test_a_body_on_another_skeleton_has_points_at_the_same_places(points):
    other = contact_points(anny_body(skeleton_by_name("smpl24")))
    scale = _in_t_pose(points).amax(0) - _in_t_pose(points).amin(0)
    away = (_in_t_pose(other) - _in_t_pose(points)) / scale.max()
    assert away.norm(dim=-1).max() < 0.25


def test_a_surface_that_is_cut_in_another_order_is_another_surface(points):
    """Rows are those of the default body's faces alone; a body of the same size with other faces is searched."""
    body = anny_body(SKELETON)
    order = torch.randperm(len(body.rest_vertices), generator=torch.Generator().manual_seed(0))
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    shuffled = replace(
        body,
        rest_vertices=body.rest_vertices[order],
        faces=place[body.faces],
        skin_joints=body.skin_joints[order],
        skin_weights=body.skin_weights[order],
    )
    torch.testing.assert_close(contact_points(shuffled).rest_vertices, points.rest_vertices)
