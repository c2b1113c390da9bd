"""Whoever opens something has a hand on its handle and is not in its way."""

from dataclasses import replace

import numpy as np
import pytest

from wearcap.body.kinematics import site_positions
from wearsim.handling import opening
from wearsim.handling.opening import operate
from wearsim.people.plan import Plan
from wearsim.people.wearer import TAIL_S, perform
from wearsim.places.interactive_flat import House, build_interactive_flat
from wearsim.places.outline import distance_to_convex

FPS, SWINGS_ON_S = 30.0, 0.7
CASES = [("door", 0), ("door", 1), ("window", 0), ("drawer", 0), ("cabinet_door", 0)]


def opened_and_closed(category, handle, person, seeds=range(8)):
    """The first flat in which something of a category can be opened by a handle and closed again."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        flat = build_interactive_flat(rng, "flat")
        house = House(flat)
        for item in (item for item in flat.openables if item.category == category and item.closed == 0.0):
            out = -(item.pose(0.0).R.numpy() @ np.array(item.handles[handle].fingers))[:2]
            start = item.handle(handle, np.array(0.0))[:2] + 0.8 * out / np.linalg.norm(out)
            plan = Plan(person, np.array([*start, 0.0]), 0.0, flat.static.floor_height)
            plan.time = 0.3
            if not operate(plan, house, rng, item, 0.85 * item.opened, handle):
                continue
            if operate(plan, house, rng, item, item.closed, handle):
                stop = plan.time + 0.5
                plan.time = stop + TAIL_S
                return flat, house, item, perform(plan, flat.static, rng, stop, FPS).motion
    pytest.fail(f"no {category} was opened and closed")


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def case(request, person):
    return request.param[1], *opened_and_closed(*request.param, person)


def test_the_palm_stays_on_the_handle_or_where_it_pushes(case):
    _, flat, house, item, motion = case
    rows, track = house.interactions(1e3), house.object_motion(motion)[item.name]
    assert len(rows) == 2
    assert rows.objects == (item.name,) * 2
    assert set(rows.classes) == {"hinged" if item.category != "drawer" else "sliding"}
    palms = site_positions(motion.skeleton, motion.T_world_joint, ("left_palm", "right_palm")).double()
    local = track.T_world_body[:, None].inverse() @ palms.float()
    assert rows.hand_contact(motion.timestamps).sum(1).max() == 1
    for start, stop, hands in zip(rows.start_s, rows.stop_s, rows.hands):
        during = (motion.timestamps >= start) & (motion.timestamps < stop)
        place = local[during, int(hands[1])]
        assert (place - place.median(0).values).norm(dim=-1).max() < 0.01
        frame = int(during.nonzero()[0])
        touched = flat.environment.nearest(palms[frame, hands], {item.name: track.T_world_body[frame]}, None, 0.5)
        assert touched.distance[0] < 0.03
        assert flat.environment.objects[int(touched.object_index[0])].name == item.name
    assert (rows.stop_s - rows.start_s).sum() > 2 * 1.0


def test_the_thing_moves_only_in_a_hand_and_within_its_limits(case):
    _, _, house, item, motion = case
    track = house.object_motion(motion)[item.name]
    rows, swings_on = house.interactions(1e3), SWINGS_ON_S if item.hinged else 0.0
    longer = replace(rows, stop_s=rows.stop_s + swings_on)
    held = longer.hand_contact(motion.timestamps).any(1)
    moved = (track.t_world_body.diff(dim=0).norm(dim=-1) > 1e-5) | (
        track.R_world_body.diff(dim=0).norm(dim=(-1, -2)) > 1e-5
    )
    assert not (moved & ~(held[1:] | held[:-1])).any()
    home = item.object.T_world_object
    assert (track.t_world_body[-1] - home.t).norm() < 1e-4, "closed again"
    if item.hinged:
        R = home.R.transpose(0, 1) @ track.R_world_body
        angle = np.arctan2(R[:, 1, 0], R[:, 0, 0])
        assert np.abs(angle).max() > 0.8 * abs(item.opened)
        assert (angle >= item.object.freedom.limits[0] - 1e-3).all()
        assert (angle <= item.object.freedom.limits[1] + 1e-3).all()
    else:
        way = (track.t_world_body - home.t) @ track.t_world_body.new_tensor(item.object.freedom.axis)
        assert way.max() > 0.8 * item.opened
        assert way.min() > -1e-4
    assert (motion.timestamps.diff() > 0).all()


def test_the_body_keeps_off_the_thing_and_the_walls(case):
    _, flat, house, item, motion = case
    track = house.object_motion(motion)[item.name]
    held = house.interactions(1e3).hand_contact(motion.timestamps).any(1).numpy()
    R, t = track.R_world_body.double().numpy(), track.t_world_body.double().numpy()
    for joint in ("pelvis", "t8"):
        place = motion.joint(joint).t.double().numpy()
        local = np.einsum("tji,tj->ti", R, place - t)[:, :2]
        level = held & (place[:, 2] < item.z_range[1])  # one bends over a low drawer
        if level.any():
            assert distance_to_convex(local[level], item.outline).min() > 0.12
        for other in flat.static.objects:
            if other.z_range[0] < 1.0 and other.z_range[1] > 0.9:
                assert distance_to_convex(place[held, :2], other.footprint).min() > 0.12, other.name


def test_a_leaf_swings_on_when_it_is_let_go_early(person, monkeypatch):
    monkeypatch.setattr(opening, "EARLY", 1.0)
    _, house, item, motion = opened_and_closed("door", 1, person)
    rows, track = house.interactions(1e3), house.object_motion(motion)[item.name]
    for first, stop in zip(rows.start_s, rows.stop_s):
        after = (motion.timestamps > stop) & (motion.timestamps < stop + SWINGS_ON_S)
        assert (track.R_world_body[after].diff(dim=0).norm(dim=(-1, -2)) > 1e-4).any(), "moves without a hand"
        assert first < stop
    assert (track.t_world_body[-1] - item.object.t_world_object).norm() < 1e-4, "closed again"
