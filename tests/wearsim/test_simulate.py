"""Simulated recordings are complete, their splits never meet, and a seed determines everything."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.recording.recording import Recording
from wearcap.recording.serialize import flatten
from wearsim.recordings import simulate
from wearsim.recordings.simulate import POOLS, SimulationConfig, person_of, simulate_recording, world_of

SHORT = SimulationConfig(duration_s=20.0)


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(SHORT, "one", "train", 7)


def test_a_recording_is_complete(recording):
    assert (recording.name, recording.source) == ("one", "wearcap simulation")
    for text in (recording.subject, recording.location, recording.activity, recording.license):
        assert text
    assert len(recording.motion) == 1200
    for stream in (recording.head, recording.contacts, recording.floor, *recording.imu.values()):
        assert torch.equal(stream.timestamps, recording.motion.timestamps)
    assert recording.contacts.parts == FOOT_PATCHES
    assert 1.4 < recording.shape["height"] < 2.0
    assert recording.skeleton == recording.motion.skeleton
    assert len(recording.points.points_world) > 500
    assert recording.points.first_seen.max() <= recording.motion.timestamps[-1]
    _, tensors = flatten(recording)
    assert all(tensor.isfinite().all() for tensor in tensors.values())


def test_sensors_agree_with_the_truth(recording):
    head = recording.head.T_world_head.t - recording.motion.joint("head").t
    assert head.norm(dim=-1).max() < 0.02
    for joint, stream in recording.imu.items():
        assert stream.joint == joint
        assert stream.acc_imu.mean(0).norm() == pytest.approx(9.81, abs=3.0)
    suit = recording.suit.t_world_root - recording.motion.t_world_root
    assert suit.norm(dim=-1).max() < 1.0


def test_a_seed_determines_everything(recording):
    again, other = (simulate_recording(SHORT, "one", "train", seed) for seed in (7, 8))
    first, second, third = (flatten(r)[1] for r in (recording, again, other))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[key], second[key]) for key in first)
    assert not torch.equal(first["motion.t_world_root"], third["motion.t_world_root"])


def test_parts_can_be_left_out():
    config = replace(SHORT, duration_s=2.0, points=False, suit=None, head_noise=None, imu_joints=())
    recording = simulate_recording(config, "bare", "val", 0)
    assert recording.points is None
    assert recording.suit is None
    assert recording.imu == {}
    torch.testing.assert_close(recording.head.T_world_head.t, recording.motion.joint("head").t, atol=2e-6, rtol=0)


def test_three_in_ten_recordings_are_outdoors_unless_a_world_is_asked_for(monkeypatch, stairs_flat):
    monkeypatch.setattr(simulate, "simulate_motion", lambda *_: None)
    monkeypatch.setattr(simulate, "drawn_person", lambda *_: None)
    monkeypatch.setattr(simulate, "world_of", lambda split, number, kind: replace(stairs_flat, name=kind))
    monkeypatch.setattr(
        simulate, "sensed_recording", lambda config, name, world, *_: Recording(name, location=world.name)
    )
    drawn = [simulate_recording(SHORT, "one", "train", seed).location for seed in range(300)]
    assert 0.22 < drawn.count("outdoor") / 300 < 0.38
    for kind in simulate.WORLDS:
        assert simulate_recording(replace(SHORT, world=kind), "one", "train", 7).location == kind
    with pytest.raises(WearcapError, match="flat or outdoor"):
        replace(SHORT, world="moon")


def test_splits_share_neither_people_nor_places():
    people = {split: {person_of(split, k).name for k in range(n)} for split, (n, _) in POOLS.items()}
    places = {split: {world_of(split, k).name for k in range(2)} for split in POOLS}
    for pools in (people, places):
        assert not pools["train"] & pools["val"]
        assert not pools["train"] & pools["test"]
        assert not pools["val"] & pools["test"]
    assert all(len(people[split]) == count for split, (count, _) in POOLS.items())


def test_the_same_number_is_another_person_and_place_in_another_split():
    heights = {person_of(split, 3).shape["height"] for split in POOLS}
    assert len(heights) == 3
    corners = {world_of(split, 3).surfaces[0].polygon[0, 0] for split in POOLS}
    assert len(corners) == 3
    assert person_of("train", 3).shape == person_of("train", 3).shape
