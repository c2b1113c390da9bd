"""Hand-held objects: their shapes, and how they are lifted, carried, used and put down."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from handled import assert_natural, level_world, palm_errors, performed, plan_at

from wearsim.handling.grips import object_motion
from wearsim.handling.holding import lift, put_down, take_options
from wearsim.handling.using import use
from wearsim.people.person import draw_person
from wearsim.people.walking import walk_along
from wearsim.places.movables import HANDHELDS, MOVABLES, TOOLS, floor_pose, make_movable

SHAPES = {**{kind: MOVABLES[kind] for kind in HANDHELDS}, **TOOLS}
START, STOP = np.array([0.0, 0.0, 0.3, 0.0]), np.array([1.4, 0.6, 0.9, 0.0])


@pytest.fixture(scope="module")
def floor():
    return level_world()


@pytest.mark.parametrize("kind", sorted(SHAPES))
def test_shapes_are_closed_and_stand_on_the_floor(kind):
    for seed in range(3):
        shape = SHAPES[kind](np.random.default_rng(seed))
        vertices = shape.object.mesh.vertices.astype(np.float64)
        assert abs(vertices[:, 2].min()) < 1e-6
        assert vertices[:, 2].max() == pytest.approx(shape.height, abs=0.01)
        edges = Counter((int(face[k]), int(face[(k + 1) % 3])) for face in shape.object.mesh.faces for k in range(3))
        assert all(edges[b, a] == count for (a, b), count in edges.items())
        a, b, c = (vertices[shape.object.mesh.faces[:, corner]] for corner in range(3))
        assert (np.cross(a, b) * c).sum() > 0, "faces look outwards"


def test_a_ball_is_round_and_a_bottle_has_a_neck():
    shape = MOVABLES["ball"](np.random.default_rng(0))
    radius = shape.height / 2
    away = np.linalg.norm(shape.object.mesh.vertices - [0.0, 0.0, radius], axis=1)
    assert np.allclose(away, radius, rtol=1e-3)
    vertices = MOVABLES["bottle"](np.random.default_rng(0)).object.mesh.vertices
    wide = np.hypot(vertices[:, 0], vertices[:, 1])
    assert wide[vertices[:, 2] > 0.9 * vertices[:, 2].max()].max() < 0.6 * wide.max()


def handled(floor, category, seed, hands=None):
    """An object lifted, used, carried some steps and put down with one hand or both."""
    rng = np.random.default_rng(seed)
    person = draw_person("p", rng)
    movable = make_movable(category, f"{category}_1", rng)
    options = take_options(plan_at(person, floor, 0.0, 0.0, 0.0), movable, START, STOP, rng)
    choice = next(option for option in options if hands in (None, len(option.places)))
    # one walks straight on
    turned = float(choice.stand[2])
    choice = replace(choice, stop=np.array([1.4 * np.cos(turned), 1.4 * np.sin(turned), START[2], 0.0]))
    plan = plan_at(person, floor, *choice.stand)
    held = lift(plan, choice, rng)
    use(plan, held, rng)
    walk_along(plan, np.stack([plan.position, [*choice.goal[:2], 0.0]]), rng, 1.0)
    handling = put_down(plan, held, rng)
    simulated = performed(plan, floor, rng)
    track = object_motion(floor_pose(START[:3]), [handling], simulated.motion)
    return plan, held, handling, simulated, track


@pytest.mark.parametrize(
    ("category", "seed", "hands"),
    [
        ("suitcase", 1, 1),
        ("backpack", 0, 1),
        ("backpack", 2, 2),
        ("bottle", 2, 1),
        ("tool", 5, 1),
        ("tool", 4, 1),
        ("tool", 3, 1),
        ("ball", 0, 2),
    ],
)
def test_a_thing_is_lifted_used_carried_and_put_down(floor, category, seed, hands):
    plan, held, handling, simulated, track = handled(floor, category, seed, hands)
    assert palm_errors(plan, simulated.motion).max() < 0.01
    assert_natural(simulated)
    choice = held.choice
    assert np.abs(track.t_world_body[-1].numpy() - choice.stop[[0, 1, 3]]).max() < 1e-4
    vertices = torch.from_numpy(choice.movable.object.mesh.vertices)
    lowest = (track.R_world_body[:, 2] @ vertices.T).amin(1) + track.t_world_body[:, 2]
    assert lowest.min() > -1e-4, "nothing goes through the floor"
    times = track.timestamps
    free = (times < handling.start_s) | (times > handling.stop_s)
    assert lowest[free].abs().max() < 1e-4, "what nobody holds stands on the floor"
    assert (track.t_world_body.diff(dim=0).norm(dim=-1)[(free[1:] & free[:-1])] < 1e-6).all()
    carried = (times > held.lifted_s) & (times < held.lifted_s + 1.0)
    assert lowest[carried].min() > 0.02
    assert sum(handling.rows[0][2]) == hands


def test_what_hangs_beside_a_leg_keeps_off_it_and_upright(floor):
    _, held, _, simulated, track = handled(floor, "suitcase", 1)
    during = (track.timestamps > held.lifted_s) & (track.timestamps < held.lifted_s + 6.0)
    assert track.R_world_body[during, 2, 2].min() > 0.9
    movable, motion = held.choice.movable, simulated.motion
    for joint in ("left_knee", "right_knee"):
        local = (track.T_world_body.inverse() @ motion.joint(joint).t)[during].numpy()
        outside = np.maximum(np.abs(local[:, :2]) - np.array(movable.half_size), 0.0)
        assert np.linalg.norm(outside, axis=1).min() > 0.02


def test_a_bottle_is_brought_to_the_mouth(floor):
    _, held, _, simulated, track = handled(floor, "bottle", 2)
    top = torch.tensor([0.0, 0.0, held.choice.movable.height])
    mouth = simulated.motion.joint("head") @ torch.tensor([0.10, 0.0, 0.0])
    away = (track.T_world_body @ top - mouth).norm(dim=-1)
    assert away.min() < 0.06
    assert track.R_world_body[away.argmin(), 2, 2] < 0.5, "it is tilted then"
