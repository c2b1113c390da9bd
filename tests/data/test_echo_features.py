"""ECHO's features: encoding is invertible, and independent of heading and position where it must be."""

import pytest
import torch

from carried_box import CLASSES, carrying, small_features
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.features import OBJECT_SIZE, Body, ThreePoints

FRAMES = ("own", "window", "world")
TURN = Rigid(rotation.about_axis("z", torch.tensor(1.3)), torch.tensor([5.0, -3.0, 0.7]))
SIZE = torch.tensor([[1.6, 0.8, 0.5, 0.5]])
BOX = "box_1"


@pytest.fixture(scope="module")
def walked() -> tuple[ThreePoints, Body, Rigid, torch.Tensor]:
    """Tracked points, body, box and floor of a walk; each with a batch axis of one."""
    recording = carrying(1.0)
    motion, track = recording.motion, recording.object_motion[BOX]
    at = motion.T_world_joint[:, motion.skeleton.indices("head", "left_wrist", "right_wrist")]
    body = Body(motion.R_parent_joint[None], motion.t_world_root[None])
    box = Rigid(track.R_world_body[None], track.t_world_body[None])
    return ThreePoints(at.R[None], at.t[None]), body, box, torch.zeros(1, len(motion))


def moved(points: ThreePoints) -> ThreePoints:
    return ThreePoints(TURN.R @ points.R_world_point, TURN @ points.t_world_point)


@pytest.mark.parametrize("frame", FRAMES)
def test_body_and_object_come_back_as_they_went_in(walked, frame):
    points, body, box, _ = walked
    features = small_features(frame)
    at = features.canonical(points)
    human, scene_object = features.encode_body(body, at), features.encode_object(box, at)
    assert human.shape[-1] == features.human_size == 3 + 6 * 23
    assert scene_object.shape[-1] == OBJECT_SIZE
    for back, given in zip(features.decode_body(human, at), body):
        torch.testing.assert_close(back, given, atol=1e-5, rtol=0)
    back = features.decode_object(scene_object, at)
    torch.testing.assert_close(back.matrix(), box.matrix(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("frame", ["window", "own"])
def test_a_head_alone_does_not_see_the_hands(walked, frame):
    points, *_, floor = walked
    waved = points._replace(t_world_point=points.t_world_point + torch.tensor([0.0, 0.1, 0.1])[:, None])
    for seen, equal in ((["head"], True), (["head", "left_wrist", "right_wrist"], False)):
        features = small_features(frame, points=seen)
        condition = features.condition(points, floor, SIZE)
        assert condition.shape[-1] == features.condition_size
        assert torch.equal(features.condition(waved, floor, SIZE), condition) == equal
    with pytest.raises(WearcapError, match="tracked points left_wrist"):
        small_features(frame, points=["left_wrist"])


@pytest.mark.parametrize("frame", FRAMES)
def test_wrists_that_are_missing_are_zeros_and_flagged(walked, frame):
    """Everything of the others stays; a rate needs the frame before, too."""
    points, *_, floor = walked
    plain, features = (
        small_features(frame, points=["head", "left_wrist", "right_wrist"]),
        small_features(frame, gaps=True),
    )
    seen = torch.ones(1, floor.shape[1], 3, dtype=torch.bool)
    whole = plain.condition(points, floor, SIZE)
    condition = features.condition(points._replace(seen=seen), floor, SIZE)
    assert condition.shape[-1] == features.condition_size == plain.condition_size + 2
    assert torch.equal(condition, torch.cat([whole, torch.ones(1, floor.shape[1], 2)], -1))
    assert torch.equal(features.condition(points, floor, SIZE), condition), "none is missing where nobody says"
    seen[0, 10:14, 2] = False
    lost = points.t_world_point.clone()
    lost[0, 10:14, 2] = 77.0
    condition = features.condition(points._replace(t_world_point=lost, seen=seen), floor, SIZE)
    right = {"R": slice(12, 18), "turn": slice(30, 36), "place": slice(42, 45), "velocity": slice(51, 54)}
    for name, columns in right.items():
        missing = (condition[0, :, columns] == 0).all(-1)
        last = 15 if name in ("turn", "velocity") else 14
        assert missing.nonzero()[:, 0].tolist() == [*range(10, last)], name
    assert torch.equal(condition[0, :, -2:], seen[0, :, 1:].float())
    others = [k for k in range(whole.shape[-1]) if not any(k in range(c.start, c.stop) for c in right.values())]
    assert torch.equal(condition[..., others], whole[..., others])


@pytest.mark.parametrize("body", [True, False])
@pytest.mark.parametrize(("frame", "size"), [("window", 54), ("world", 54), ("own", 56)])
def test_sizes_are_the_papers(walked, frame, size, body):
    features = small_features(frame, body=body)
    assert features.condition_size == size + 5 * body
    points, *_, floor = walked
    assert features.condition(points, floor, SIZE).shape == (1, 30, features.condition_size)
    assert features.moves == (frame == "window")


@pytest.mark.parametrize("frame", FRAMES)
def test_north_and_place_matter_in_the_world_alone(walked, frame):
    points, body, box, floor = walked
    features, turned = small_features(frame), moved(points)
    here, there = features.canonical(points), features.canonical(turned)
    root = TURN @ Rigid(body.R_parent_joint[:, :, 0], body.t_world_root)
    elsewhere = Body(torch.cat([root.R[:, :, None], body.R_parent_joint[:, :, 1:]], 2), root.t)
    pairs = [
        (features.condition(points, floor, SIZE), features.condition(turned, floor + TURN.t[2], SIZE)),
        (features.encode_body(body, here), features.encode_body(elsewhere, there)),
        (features.encode_object(box, here), features.encode_object(TURN @ box, there)),
    ]
    for value, other in pairs:
        assert torch.allclose(value, other, atol=1e-4) == (frame != "world")


@pytest.mark.parametrize("frame", FRAMES)
def test_canonical_frames_are_the_heads_and_upright(walked, frame):
    points, *_ = walked
    at = small_features(frame).canonical(points)
    up = at.R[..., 2]
    torch.testing.assert_close(up, torch.tensor([0.0, 0.0, 1.0]).expand_as(up))
    head = points.t_world_point[:, :, 0]
    expected = {"own": head, "window": head[:, :1], "world": torch.zeros(1, 1, 3)}[frame]
    assert torch.equal(at.t, expected)


@pytest.mark.parametrize("frame", FRAMES)
def test_the_condition_is_eq_4(walked, frame):
    """Rotations, their change since the previous frame, positions and velocities, written out point by point."""
    points, *_, floor = walked
    features = small_features(frame, body=False)
    condition = features.condition(points, floor, SIZE)[0]
    at, (R, t, _) = features.canonical(points), points
    for k in (1, 17):
        own = at.R[0, min(k, at.R.shape[1] - 1)].mT
        origin = at.t[0, min(k, at.t.shape[1] - 1)]
        for p in range(3):
            turned = own @ R[0, k, p]
            torch.testing.assert_close(condition[k, 6 * p : 6 * p + 6], turned[:, :2].T.flatten(), atol=1e-5, rtol=0)
            step = R[0, k - 1, p].mT @ R[0, k, p]
            torch.testing.assert_close(
                condition[k, 18 + 6 * p : 24 + 6 * p], step[:, :2].T.flatten(), atol=1e-5, rtol=0
            )
            velocity = own @ (t[0, k, p] - t[0, k - 1, p]) * 30
            torch.testing.assert_close(condition[k, 45 + 3 * p : 48 + 3 * p], velocity, atol=1e-4, rtol=0)
            if p or frame != "own":
                place = own @ (t[0, k, p] - origin)
                torch.testing.assert_close(condition[k, 36 + 3 * p : 39 + 3 * p], place, atol=1e-5, rtol=0)


def test_in_its_own_frame_the_heads_path_is_relative_to_the_windows_first_frame(walked):
    points, *_, floor = walked
    own, window = (small_features(frame, body=False).condition(points, floor, SIZE) for frame in ("own", "window"))
    torch.testing.assert_close(own[..., 36:39], window[..., 36:39], atol=1e-5, rtol=0)
    heading = own[0, :, 54:]
    torch.testing.assert_close(heading.norm(dim=-1), torch.ones(30), atol=1e-5, rtol=0)
    torch.testing.assert_close(heading[0], torch.tensor([1.0, 0.0]), atol=1e-5, rtol=0)


def test_a_single_frame_can_be_encoded():
    points = ThreePoints(torch.eye(3).expand(1, 1, 3, 3, 3), torch.rand(1, 1, 3, 3))
    condition = small_features().condition(points, torch.zeros(1, 1), SIZE)
    assert condition.isfinite().all()


def test_classes_are_one_hot_codes():
    features = small_features()
    codes = torch.stack([features.class_code(name) for name in CLASSES])
    assert torch.equal(codes, torch.eye(len(CLASSES)))
    with pytest.raises(WearcapError, match="no object class 'tree'. Expected one of box, chair"):
        features.class_code("tree")


def test_an_unknown_frame_is_refused():
    with pytest.raises(WearcapError, match="no frame 'moon'. Expected one of own, window, world"):
        small_features("moon")
