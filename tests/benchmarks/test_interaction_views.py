"""What the head camera sees of hands in simulated interactions, and what a detector makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.tables import seen_flat
from benchmarks.tables import simulated_detections as detecting
from wearcap.geometry.rotation import about_axis
from wearcap.recording import Recording
from wearsim.recordings.interaction_session import InteractionConfig, simulate_interactions

PERFECT = detecting.Detector(found=1.0, side=1.0, state=1.0, apart=1.0, false_hands=0.0, whole=0.01)
EVERY = 15


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Half a minute, filmed by a camera that looks down at the hands."""
    found = simulate_interactions(InteractionConfig(minutes=0.5), "session", "val", 3)[0]
    assert found.camera is not None
    down = about_axis("y", torch.tensor(np.deg2rad(40.0)).float())
    return replace(found, camera=replace(found.camera, R_head_cam=down @ found.camera.R_head_cam))


@pytest.fixture(scope="module")
def seen(recording):
    found = seen_flat.SeenFlat.of(recording)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def hands(seen):
    return detecting.seen_hands(seen, EVERY)


@pytest.fixture(scope="module")
def touching(recording):
    return recording.interactions.hand_contact(recording.camera.timestamps[::EVERY].contiguous()).numpy()


def test_a_flat_that_is_not_the_recordings_is_not_taken_for_it(recording):
    name, track = next(iter(recording.object_motion.items()))
    moved = replace(track, t_world_body=track.t_world_body + 0.1)
    assert seen_flat.SeenFlat.of(replace(recording, object_motion=recording.object_motion | {name: moved})) is None
    assert seen_flat.SeenFlat.of(replace(recording, location="MPI_EG")) is None


def test_hands_are_seen_in_the_picture_and_mostly_while_they_are_at_work(hands, touching):
    inside = hands.share > 0
    assert 0.01 < inside.mean() < 0.6
    assert inside[touching].mean() > inside[~touching].mean()
    boxes = hands.box[inside]
    assert (boxes[:, :2] <= boxes[:, 2:]).all()
    assert (boxes >= -0.5).all()
    assert (boxes < [960, 540, 960, 540]).all()
    assert hands.object_box.any(-1)[inside & touching].mean() > 0.9, "what is touched is behind the hand"


def test_a_perfect_detector_knows_every_hand_in_sight_and_none_else(hands, touching):
    size, rng = (960, 540), np.random.default_rng(0)
    frames = detecting.detections(hands, touching, PERFECT, rng, EVERY, size)
    found = np.full((len(frames), 2), -1)
    for k, frame in enumerate(frames):
        assert frame["frame"] == EVERY * k
        for row in frame["hand_dets"] or ():
            found[k, int(row[-1])] = row[5] > 0
    whole = hands.share >= PERFECT.whole
    assert ((found >= 0) <= (hands.share > 0)).all()
    assert (found[whole] == touching[whole]).all()


def test_a_real_detector_misses_and_mistakes_as_often_as_published(hands, touching):
    count = 40_000
    many = detecting.SeenHands(np.ones((count, 2)), np.ones((count, 2, 4)), np.ones((count, 2, 4)))
    contact = np.zeros((count, 2), bool)
    frames = detecting.detections(many, contact, detecting.HOD, np.random.default_rng(0), 1, (960, 540))
    rows = np.array([row for frame in frames for row in frame["hand_dets"] or ()])
    assert len(rows) / (2 * count) == pytest.approx(0.905 + 0.01, abs=0.01)
    assert (rows[:, 5] > 0).mean() == pytest.approx(1 - 0.75 / 0.90, abs=0.015)
