"""Sessions of interactions: the ground truth of hands and objects agrees with the bodies' motion."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearsim.places.outline import distance_to_convex
from wearsim.recordings.interaction_session import FLATS, InteractionConfig, flat_of, simulate_interactions

CONFIG = InteractionConfig(minutes=1.0)


@pytest.fixture(scope="module")
def simulated():
    return simulate_interactions(CONFIG, "session", "val", 4)


@pytest.fixture(scope="module")
def recording(simulated):
    return simulated[0]


def test_a_recording_has_all_its_parts(simulated, recording):
    names = {item.name for item in simulated[1].environment.objects}
    assert set(recording.object_motion) == names
    assert set(recording.interactions.objects) <= names
    assert len(recording.interactions) >= 2
    assert recording.suit.fps == pytest.approx(60.0)
    assert recording.duration_s == pytest.approx(60.0, abs=0.2)
    for track in recording.object_motion.values():
        assert torch.equal(track.timestamps, recording.motion.timestamps)
    found = recording.localization.confidence > 0
    assert 0.8 < found.double().mean() <= 1.0
    assert recording.location == "sim-val-interactive_flat-004"


def test_rows_of_one_hand_do_not_overlap(recording):
    rows = recording.interactions
    assert (rows.stop_s > rows.start_s).all()
    for hand in range(2):
        spans = [(a, b) for a, b, h in zip(rows.start_s, rows.stop_s, rows.hands[:, hand]) if h]
        assert all(before[1] <= after[0] + 1e-9 for before, after in pairwise(spans))
    held = (rows.stop_s - rows.start_s).sum() / 60.0
    assert 0.05 < held < 0.8


def test_a_palm_that_holds_keeps_its_place_on_the_thing(recording):
    motion, rows, times = recording.motion, recording.interactions, recording.motion.timestamps
    palms = site_positions(motion.skeleton, motion.T_world_joint, ("left_palm", "right_palm"))
    for k, name in enumerate(rows.objects):
        during = (times >= rows.start_s[k]) & (times < rows.stop_s[k])
        pose = recording.object_motion[name].T_world_body[during]
        for hand in range(2):
            if rows.hands[k, hand] and during.sum() > 1:
                local = pose.inverse() @ palms[during, hand]
                assert (local - local.median(0).values).norm(dim=-1).max() < 0.01, name


def test_palms_in_contact_are_at_the_surface(simulated, recording):
    motion, rows = recording.motion, recording.interactions
    palms = site_positions(motion.skeleton, motion.T_world_joint, ("left_palm", "right_palm"))
    for k, name in enumerate(rows.objects):
        frame = int(torch.searchsorted(motion.timestamps, (rows.start_s[k] + rows.stop_s[k]) / 2))
        poses = {key: track.T_world_body[frame] for key, track in recording.object_motion.items()}
        for hand in np.flatnonzero(rows.hands[k].numpy()):
            nearest = simulated[1].environment.nearest(palms[frame, hand][None], poses, None, 0.5)
            assert nearest.distance[0] < 0.03, (name, hand)


def test_things_rest_when_nobody_holds_them(recording):
    rows, times = recording.interactions, recording.motion.timestamps
    for name, track in recording.object_motion.items():
        held = torch.zeros(len(times), dtype=torch.bool)
        for k, other in enumerate(rows.objects):
            if other == name:
                swings_on = 0.7 if rows.classes[k] == "hinged" else 0.0
                held |= (times >= rows.start_s[k] - 1 / 60) & (times <= rows.stop_s[k] + 1 / 60 + swings_on)
        moved = track.t_world_body.diff(dim=0).norm(dim=-1) > 1e-5
        assert not (moved & ~(held[1:] | held[:-1])).any(), name


def test_things_keep_to_their_freedom(simulated, recording):
    for item in simulated[1].environment.objects:
        track, freedom = recording.object_motion[item.name], item.freedom
        up = track.R_world_body[:, 2, 2]
        assert (up > 1 - 1e-5).all(), "objects stay upright"
        if freedom.kind != "free":
            assert (track.t_world_body[:, 2] - item.t_world_object[2]).abs().max() < 1e-4
        if freedom.kind == "hinge":
            pivot = torch.tensor(freedom.pivot)
            radius = (track.t_world_body - pivot)[:, :2].norm(dim=-1)
            assert (radius - radius[0]).abs().max() < 1e-4


def test_bodies_are_not_in_walls_or_shut_doors(simulated, recording):
    flat = simulated[1]
    for joint in ("pelvis", "t8"):
        place = recording.motion.joint(joint).t.double().numpy()[::3]
        for wall in (item for item in flat.static.objects if item.kind == "wall"):
            level = (place[:, 2] > wall.z_range[0]) & (place[:, 2] < wall.z_range[1])
            if level.any():
                assert distance_to_convex(place[level, :2], wall.footprint).min() > 0.0, wall.name
        for door in (item for item in flat.openables if item.category == "door"):
            track = recording.object_motion[door.name].T_world_body[::3]
            local = (track.inverse() @ torch.from_numpy(place).float())[:, :2].double().numpy()
            assert distance_to_convex(local, door.outline).min() > 0.0, door.name


def test_a_seed_gives_one_recording_and_another_seed_another():
    short = InteractionConfig(minutes=0.1)
    one, two, other = (simulate_interactions(short, "x", "val", seed)[0] for seed in (1, 1, 2))
    assert torch.equal(one.motion.R_parent_joint, two.motion.R_parent_joint)
    assert torch.equal(one.localization.t_world_cam, two.localization.t_world_cam)
    assert one.interactions.objects == two.interactions.objects
    assert not torch.equal(one.motion.t_world_root, other.motion.t_world_root)


def test_splits_share_no_flat():
    flats = [flat_of(split, number) for split in FLATS for number in range(1)]
    assert len({flat.static.name for flat in flats}) == len(flats)
    shapes = [flat.environment.objects[0].mesh.vertices for flat in flats]
    assert all(not np.array_equal(a, b) for k, a in enumerate(shapes) for b in shapes[:k])


def test_impossible_settings_are_refused():
    with pytest.raises(WearcapError, match="min"):
        InteractionConfig(minutes=0.0)
