"""Static-object constraint: untouched objects keep their last touched pose, before their first contact its pose."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from carried_box import carrying, drawn_echo, scenario_of
from wearcap.body.contact_points import BODY_POINTS
from wearcap.geometry import rotation
from wearcap.systems.echo.contacts import FADE, INSIDE, StaticObjects, inside, with_static_objects
from wearcap.systems.echo.features import CONTACTS
from wearcap.systems.echo.queue import Conditioning, Outputs

TOUCH = 0.7
ACTS = [-1, 0, 0, 0, 0, 0, 0, 1, 1, 1, -1, 1, 1, 1, 0, 0]
"""Numbers of the active object."""
TOUCHED = [3, 4, 11, 15]
"""Frames in which it is touched."""
MOVED = [0, 3, 3, 3, 4, 4, 4, 11, 11, 11, 10, 11, 11, 11, 4, 15]
"""Frames whose poses are taken: the first act of object 1 has no contact, its second begins with one; object 0 comes
back where it was left."""


def frames(active=ACTS, touched=TOUCHED, observed=()) -> tuple[Conditioning, Outputs]:
    """Objects that move a metre and turn a little in every frame; one point of the body touches."""
    count = len(active)
    number = torch.tensor([active], dtype=torch.float32)
    eye, zeros = torch.eye(3).repeat(1, count, 1, 1), torch.zeros(1, count, 3)
    contact = torch.full((1, count, CONTACTS), 0.6)
    contact[..., BODY_POINTS:] = 1.0
    contact[0, touched, 12] = TOUCH
    observed_parts = torch.zeros(1, count, 3, dtype=torch.bool)
    observed_parts[0, list(observed), 1] = True
    conditioning = Conditioning(
        torch.arange(count, dtype=torch.float64)[None] / 30,
        eye[:, :, None].repeat(1, 1, 3, 1, 1),
        zeros[:, :, None].repeat(1, 1, 3, 1),
        zeros[..., 0],
        number >= 0,
        zeros[..., :1],
        zeros[..., :1],
        number,
        number > -2,
        eye[:, :, None],
        zeros,
        eye,
        zeros,
        contact,
        observed_parts,
        torch.ones(1, count, 3, dtype=torch.bool),
    )
    path = torch.arange(count, dtype=torch.float32)
    turn = rotation.exp(torch.stack([0 * path, 0 * path, 0.1 * path], -1))
    return conditioning, Outputs(
        eye[:, :, None], zeros, turn[None], torch.stack([path, 0 * path, 0 * path], -1)[None], contact
    )


def places(outputs: Outputs) -> list[int]:
    assert torch.equal(outputs.R_world_object, frames()[1].R_world_object[:, outputs.t_world_object[0, :, 0].long()])
    return outputs.t_world_object[0, :, 0].long().tolist()


def test_objects_move_while_they_are_touched_alone():
    conditioning, outputs = frames()
    found = with_static_objects(conditioning, outputs, TOUCH)
    assert places(found) == MOVED
    assert found.contact_prob is outputs.contact_prob


def test_poses_from_within_a_contact_count():
    """The ends of one are left out, but not where it may have begun before the recording, or go on after it."""
    long = 2 * INSIDE + 4
    touched = torch.zeros(1, 100, dtype=torch.bool)
    touched[0, 5 : 5 + long] = True
    assert inside(touched)[0].nonzero()[:, 0].tolist() == [5 + INSIDE + k for k in range(4)]
    touched[0, 40:47] = True
    assert inside(touched)[0, 35:50].nonzero()[:, 0].tolist() == [8]
    touched[0, 80:] = True
    assert inside(touched)[0, 60:].nonzero()[:, 0].tolist() == list(range(20 + INSIDE, 40))
    assert inside(touched.flip(1)).equal(inside(touched).flip(1))
    assert inside(torch.ones(2, 7, dtype=torch.bool)).all()
    assert not inside(torch.zeros(2, 7, dtype=torch.bool)).any()


def test_an_object_waits_where_it_is_drawn_within_the_contact():
    stop = 10 + 3 * INSIDE
    conditioning, outputs = frames([0] * 60, list(range(10, stop)))
    path = with_static_objects(conditioning, outputs, TOUCH).t_world_object[0, :, 0].long().tolist()
    first, last = 10 + INSIDE, stop - 1 - INSIDE
    assert path == [min(max(k, first), last) for k in range(60)]


def again(observed=()) -> tuple[Conditioning, Outputs, int]:
    """Frames with two contacts and a rest between, and the first frame of the second."""
    back = 70
    return *frames([0] * 140, [*range(10, 50), *range(back, 140)], observed), back


def test_an_object_that_is_touched_again_comes_from_where_it_was_left():
    """Without a jump, although the predicted pose is elsewhere."""
    conditioning, outputs, back = again()
    found = with_static_objects(conditioning, outputs, TOUCH)
    path = found.t_world_object[0, :, 0]
    left, begin = 49 - INSIDE, back + INSIDE
    assert path[left : begin + 1].tolist() == [left] * (begin + 1 - left)
    assert path[begin + FADE :].tolist() == list(range(begin + FADE, 140))
    assert (path.diff() >= 0).all()
    assert path.diff().max() <= 1 + (begin - left) / FADE + 1e-4
    R = found.R_world_object[0]
    steps = rotation.log(R[1:] @ R[:-1].mT).norm(dim=-1)
    assert steps.max() <= 0.1 + torch.pi / FADE + 1e-4, "it takes the shorter rotation"


def test_frame_by_frame_it_comes_from_there_too():
    conditioning, outputs, back = again()
    step, path = StaticObjects(TOUCH), []
    for k in range(140):
        one = slice(k, k + 1)
        path.append(
            step(conditioning.frames(one), Outputs(*(field[:, one] for field in outputs)))
            .t_world_object[0, 0, 0]
            .item()
        )
    assert path[49 : back + 1] == [49.0] * (back + 1 - 49)
    assert path[back + FADE :] == list(range(back + FADE, 140))
    assert max(b - a for a, b in pairwise(path)) <= 1 + (back - 49) / FADE + 1e-4


def test_from_an_observed_pose_on_nothing_fades():
    """The observed pose and the predictions after it are unchanged."""
    seen = 85
    conditioning, outputs, _ = again(observed=[seen])
    path = with_static_objects(conditioning, outputs, TOUCH).t_world_object[0, :, 0]
    assert path[seen:].tolist() == list(range(seen, 140))
    assert path[seen - 1] < seen - 1
    step, streamed = StaticObjects(TOUCH), []
    for k in range(140):
        one = slice(k, k + 1)
        streamed.append(
            step(conditioning.frames(one), Outputs(*(field[:, one] for field in outputs)))
            .t_world_object[0, 0, 0]
            .item()
        )
    assert streamed[seen:] == list(range(seen, 140))


def test_an_observed_pose_is_believed_without_a_contact():
    conditioning, outputs = frames(observed=[6, 9])
    assert places(with_static_objects(conditioning, outputs, TOUCH)) == [
        0,
        3,
        3,
        3,
        4,
        4,
        6,
        9,
        9,
        9,
        10,
        11,
        11,
        11,
        6,
        15,
    ]


def test_feet_on_the_floor_touch_no_object():
    conditioning, outputs = frames(touched=[])
    assert places(with_static_objects(conditioning, outputs, 0.65)) == list(range(len(ACTS)))


def test_static_objects_of_batch_items_are_independent():
    one, other = frames(), frames(touched=[5, 9])
    both = [type(a)(*(torch.cat(fields) for fields in zip(a, b))) for a, b in zip(one, other)]
    found = with_static_objects(*both, TOUCH)
    for k, (conditioning, outputs) in enumerate((one, other)):
        assert torch.equal(
            found.t_world_object[k : k + 1], with_static_objects(conditioning, outputs, TOUCH).t_world_object
        )


def test_frame_by_frame_it_is_the_same_from_the_first_contact_on():
    conditioning, outputs = frames()
    step = StaticObjects(TOUCH)
    path = []
    for k in range(len(ACTS)):
        one = slice(k, k + 1)
        path.append(
            step(conditioning.frames(one), Outputs(*(field[:, one] for field in outputs))).t_world_object[0, 0, 0]
        )
    assert [int(x) for x in path] == [0, 1, 2, *MOVED[3:7], 7, 8, 9, *MOVED[10:15], 4], (
        "the last is touched, and still left"
    )


@pytest.mark.parametrize(("threshold", "contacts"), [(None, True), (0.0, False)])
def test_without_contacts_objects_are_as_they_are_drawn(threshold, contacts):
    recording = carrying(1.0)
    scenario = scenario_of(recording)
    echo = drawn_echo(static_threshold=threshold)
    echo = replace(echo, model=replace(echo.model, contacts=contacts))
    motion = echo.capture_scenarios([scenario], [0])[0]
    track = motion.object_motion["box_1"]
    active = (motion.timestamps >= 0.4) & (motion.timestamps < 1.2)
    assert echo.contact_use.static_threshold is None
    assert (track.t_world_body[active].diff(dim=0).norm(dim=-1) > 0).all()
