"""Things that are pushed, pulled, turned and carried, and what only looks like it."""

import numpy as np
import pytest
import torch
from handled import FPS, assert_natural, level_world, palm_errors, performed, plan_at

from wearcap.body.kinematics import site_positions
from wearcap.geometry import rotation
from wearcap.scene.objects import Environment
from wearsim.handling.distractors import bend_over, gesture_at, hover, rest_on, squat_by, stand_by
from wearsim.handling.grips import Grip, GripPlace, Handling, object_motion, still
from wearsim.handling.holding import carry_options, lift, put_down
from wearsim.handling.sliding import slide, slide_options
from wearsim.people.person import draw_person
from wearsim.people.plan import SIDES
from wearsim.people.walking import turn_to, walk_along
from wearsim.places.movables import MOVABLES, floor_pose, make_movable
from wearsim.places.outline import distance_to_convex, rectangle


@pytest.fixture(scope="module")
def floor():
    return level_world()


def slid(floor, category, target, seed, hands=None):
    """An object slid from the origin to a target by a wearer who stands where it begins."""
    rng = np.random.default_rng(seed)
    person = draw_person("p", rng)
    movable = make_movable(category, f"{category}_1", rng)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    options = slide_options(plan, movable, np.zeros(3), np.array(target), rng)
    choice = next(option for option in options if hands is None or len(option.places) == hands)
    x, y, heading = choice.stand
    plan = plan_at(person, floor, x - 0.1, y, heading + 0.2)
    handling = slide(plan, choice, rng)
    simulated = performed(plan, floor, rng)
    track = object_motion(movable.object.T_world_object, [handling], simulated.motion)
    return plan, choice, handling, simulated, track


@pytest.mark.parametrize(
    ("category", "target", "hands"),
    [("sofa", (0.9, 0.1, 0.0), 2), ("table", (0.2, 0.3, 1.3), 2), ("chair", (-0.7, 0.1, 0.0), 1)],
)
def test_a_thing_goes_where_it_should_with_the_hands_on_it(floor, category, target, hands):
    plan, choice, handling, simulated, track = slid(floor, category, target, 3, hands)
    assert palm_errors(plan, simulated.motion).max() < 0.003
    assert_natural(simulated)
    assert (track.t_world_body[-1, :2] - torch.tensor(target[:2])).abs().max() < 1e-4
    assert rotation.yaw_of(track.R_world_body)[-1].item() == pytest.approx(target[2], abs=1e-4)
    moving = track.t_world_body.diff(dim=0).norm(dim=-1) > 1e-5
    times = simulated.motion.timestamps
    held = torch.stack([(times >= start) & (times < stop) for start, stop, _ in handling.rows]).any(0)
    assert held[1:][moving].all(), "it moves only while it is held"
    half_deep, half_wide = choice.movable.half_size
    for frame in range(0, len(track), 5):
        x, y, _ = track.t_world_body[frame].tolist()
        outline = rectangle((x, y), (2 * half_deep, 2 * half_wide), float(rotation.yaw_of(track.R_world_body[frame])))
        pelvis = simulated.motion.t_world_root[frame : frame + 1, :2].double().numpy()
        assert distance_to_convex(pelvis, outline).min() > 0.2


def test_one_hand_only_translates(floor):
    for seed in range(12):
        rng = np.random.default_rng(seed)
        plan = plan_at(draw_person("p", rng), floor, 0.0, 0.0, 0.0)
        for category in ("table", "chair"):
            movable = make_movable(category, category, rng)
            for option in slide_options(plan, movable, np.zeros(3), np.array([0.5, 0.2, 0.8]), rng):
                assert option.hands == (SIDES,)
            for option in slide_options(plan, movable, np.zeros(3), np.array([0.5, 0.2, 0.02]), rng):
                assert np.ptp(option.object_at(np.linspace(0, 1, 9))[:, 2]) == 0.0


def test_rows_are_split_where_the_hands_change():
    place, moves = GripPlace((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), still(floor_pose(np.zeros(3)))
    held = (("left", 1.0, 4.0), ("right", 2.0, 6.0), ("left", 7.0, 8.0))
    grips = [(side, Grip(place, moves, start, stop)) for side, start, stop in held]
    handling = Handling.of("box_1", "sliding", moves, grips)
    assert handling.rows == (
        (1.0, 2.0, (True, False)),
        (2.0, 4.0, (True, True)),
        (4.0, 6.0, (False, True)),
        (7.0, 8.0, (True, False)),
    )
    assert (handling.start_s, handling.stop_s) == (1.0, 8.0)


def test_a_box_is_lifted_carried_and_put_down(floor):
    rng = np.random.default_rng(2)
    person = draw_person("p", rng)
    movable = make_movable("box", "box_1", rng)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    start, stop = np.array([0.0, 0.0, 0.3, 0.0]), np.array([2.0, 1.5, 1.0, 0.7])
    choice = next(carry_options(plan, movable, start, stop, rng))
    x, y, heading = choice.stand
    plan = plan_at(person, floor, x, y, heading)
    lifted = lift(plan, choice, rng)
    walk_along(plan, np.stack([plan.position, [*choice.goal[:2], 0.0]]), rng, 1.0)
    turn_to(plan, choice.goal[2], rng)
    handling = put_down(plan, lifted, rng)
    simulated = performed(plan, floor, rng)
    assert palm_errors(plan, simulated.motion).max() < 0.01
    assert_natural(simulated)
    track = object_motion(floor_pose(start[:3], start[3]), [handling], simulated.motion)
    assert np.abs(track.t_world_body[-1].numpy() - stop[[0, 1, 3]]).max() < 1e-4
    carried = (track.timestamps > lifted.lifted_s) & (track.timestamps < lifted.lifted_s + 2.0)
    level = track.t_world_body[carried, 2] + choice.places["left"].point[2]
    assert 0.8 < level.mean() < 1.3
    assert handling.rows[0][2] == (True, True)


@pytest.mark.parametrize("category", ["table", "box"])
def test_distractors_stay_off_the_thing(floor, category):
    rng = np.random.default_rng(6)
    person = draw_person("p", rng)
    movable = make_movable(category, category, rng)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    if category == "box":
        choice = next(carry_options(plan, movable, np.zeros(4), np.zeros(4), rng))
    else:
        choice = next(slide_options(plan, movable, np.zeros(3), np.array([1.0, 0.0, 0.0]), rng))
    plan = plan_at(person, floor, *choice.stand)
    pose = movable.object.T_world_object
    hover(plan, choice.places, pose, rng)
    for act in (gesture_at, bend_over, squat_by, stand_by):
        act(plan, pose, movable.height, rng)
    simulated = performed(plan, floor, rng)
    assert_natural(simulated)
    low, high = movable.object.mesh.vertices.min(0), movable.object.mesh.vertices.max(0)
    for side in SIDES:
        wrist = simulated.motion.joint(f"{side}_wrist").t.numpy()
        outside = np.maximum(np.maximum(low - wrist, wrist - high), 0.0)
        assert np.linalg.norm(outside, axis=1).min() > 0.01


def test_hands_rest_on_a_thing_that_stays_and_hover_short_of_it(floor):
    rng = np.random.default_rng(4)
    person, movable = draw_person("p", rng), make_movable("table", "table_1", rng)
    plan = plan_at(person, floor, 0.0, 0.0, 0.0)
    options = slide_options(plan, movable, np.zeros(3), np.array([1.0, 0.0, 0.0]), rng)
    choice = next(option for option in options if len(option.places) == 2)
    plan = plan_at(person, floor, *choice.stand)
    pose = movable.object.T_world_object
    handling = rest_on(plan, movable.object, choice.places, pose, rng)
    hover(plan, choice.places, pose, rng)
    simulated = performed(plan, floor, rng)
    assert_natural(simulated)
    assert palm_errors(plan, simulated.motion).max() < 0.003
    edges = sorted({edge for start, stop, _ in handling.rows for edge in (start, stop)})
    assert len(edges) == 4, "each hand comes and goes in its own time"
    track = object_motion(pose, [handling], simulated.motion)
    assert track.t_world_body.abs().max() == 0.0
    table = Environment((movable.object,))
    palms = site_positions(simulated.motion.skeleton, simulated.motion.T_world_joint, ("left_palm", "right_palm"))
    for side, palm in zip(SIDES, palms.unbind(1)):
        for grip, least, most in zip(plan.grips[side], (0.0, 0.03), (0.02, 0.25)):
            frame = int((grip.touch_s + grip.release_s) / 2 * FPS)
            assert least <= table.nearest(palm[frame : frame + 1]).distance[0] < most


@pytest.mark.parametrize("category", sorted(MOVABLES))
def test_hands_lie_on_the_things_surface(category):
    for seed in range(3):
        movable = make_movable(category, category, np.random.default_rng(seed))
        low, high = movable.object.mesh.vertices.min(0), movable.object.mesh.vertices.max(0)
        assert np.allclose(high[:2], movable.half_size, atol=0.02)
        places = [rail.at(share * rail.length) for rail in movable.rails for share in (0.0, 0.4, 1.0)]
        places += [place for left, right, _ in movable.sides for place in (left, right)]
        places += [grasp.place for grasp in movable.grasps]
        assert places
        for place in places:
            point = np.array(place.point)
            assert ((point > low - 0.011) & (point < high + 0.011)).all()
            assert np.abs(np.dot(place.normal, place.fingers)) < 1e-6 or category == "box" or movable.sides
