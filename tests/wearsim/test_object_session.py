"""Sessions with hand-held objects: the ground truth is consistent, and the other sessions' flats are as before."""

import hashlib

import numpy as np
import pytest
import torch

from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearsim.handling.grips import Handling
from wearsim.handling.household import VARIED, Household
from wearsim.places.interactive_flat import House
from wearsim.places.movables import HANDHELDS
from wearsim.recordings.interaction_session import ObjectConfig, flat_of, object_flat_of, simulate_objects
from wearsim.recordings.simulate import POOLS, person_of


@pytest.fixture(scope="module")
def simulated():
    return simulate_objects(ObjectConfig(minutes=0.8), "session", "val", 1)


def test_a_recording_has_all_its_parts(simulated):
    recording = simulated[0]
    categories = {item.category for item in simulated[1].environment.objects}
    assert categories >= {*HANDHELDS, "door", "sofa", "table", "chair", "box", "drawer"}
    assert set(HANDHELDS) == set(HANDHELDS)
    assert set(recording.object_motion) == {item.name for item in simulated[1].environment.objects}
    assert recording.motion.fps == pytest.approx(30.0)
    assert recording.head.timestamps[-1] == pytest.approx(48.0, abs=0.2)
    assert recording.suit is recording.camera is recording.points is None
    assert recording.location.startswith("sim-val-object_flat")
    assert len(recording.interactions.objects) >= 1


def test_palms_stay_on_what_they_hold(simulated):
    recording, rows = simulated[0], simulated[0].interactions
    motion, times = recording.motion, recording.motion.timestamps
    palms = site_positions(motion.skeleton, motion.T_world_joint, ("left_palm", "right_palm"))
    for k, name in enumerate(rows.objects):
        during = (times >= rows.start_s[k]) & (times < rows.stop_s[k])
        pose = recording.object_motion[name].T_world_body[during]
        for hand in range(2):
            if rows.hands[k, hand] and during.sum() > 1:
                local = pose.inverse() @ palms[during, hand]
                assert (local - local.median(0).values).norm(dim=-1).max() < 0.01, name


def test_things_rest_unless_held_and_nothing_is_below_the_floor(simulated):
    recording, times = simulated[0], simulated[0].motion.timestamps
    rows = recording.interactions
    for item in simulated[1].environment.objects:
        track = recording.object_motion[item.name]
        held = torch.zeros(len(times), dtype=torch.bool)
        for k, name in enumerate(rows.objects):
            if name == item.name:
                swings_on = 0.7 if rows.classes[k] == "hinged" else 0.0
                held |= (times >= rows.start_s[k] - 0.04) & (times <= rows.stop_s[k] + 0.04 + swings_on)
        moved = track.t_world_body.diff(dim=0).norm(dim=-1) > 1e-5
        assert not (moved & ~(held[1:] | held[:-1])).any(), item.name
        lowest = (track.R_world_body[:, 2] @ torch.from_numpy(item.mesh.vertices).T).amin(1)
        assert (lowest + track.t_world_body[:, 2]).min() > -1e-3, item.name


def test_a_seed_gives_one_recording_and_another_seed_another(simulated):
    short = ObjectConfig(minutes=0.1)
    one, two = (simulate_objects(short, "x", "val", 1)[0] for _ in range(2))
    assert torch.equal(one.motion.R_parent_joint, two.motion.R_parent_joint)
    assert torch.equal(one.head.t_world_device, two.head.t_world_device)
    other = simulate_objects(short, "x", "val", 1 + POOLS["val"][1])[0]
    assert other.location == one.location
    assert not torch.equal(one.motion.t_world_root, other.motion.t_world_root)


def test_every_hand_held_kind_is_handled():
    flat = object_flat_of("val", 1)
    house = House(flat)
    household = Household(house, person_of("val", 1), np.random.default_rng(0), VARIED)
    for kind in HANDHELDS:
        names = [movable.name for movable in flat.movables if movable.category == kind]
        assert any(household.use(name) == f"move {kind}" for name in names for _ in range(4)), kind
    assert {handling.name.rpartition("_")[0] for handling in house.handlings} >= set(HANDHELDS)


def test_what_was_held_less_is_gone_for_more():
    flat = object_flat_of("val", 1)
    house = House(flat)
    household = Household(house, person_of("val", 1), np.random.default_rng(0), VARIED)
    before = household._weight("ball")
    moves = lambda times, chest: house.poses["ball_1"]  # noqa: E731
    house.handlings.append(Handling("ball_1", "sliding", moves, ((0.0, 20.0, (True, True)),)))
    assert household._weight("ball") < 0.3 * before


def test_flats_without_hand_held_things_are_what_they_were():
    flat = flat_of("val", 0)
    digest = hashlib.sha256()
    for item in flat.environment.objects:
        digest.update(f"{item.name} {item.t_world_object.tolist()}".encode())
        digest.update(np.round(item.mesh.vertices, 4).tobytes())
    assert digest.hexdigest()[:16] == "cbc37c96ed5d2aae"


def test_impossible_settings_are_refused():
    with pytest.raises(WearcapError, match="min"):
        ObjectConfig(minutes=0.0)
