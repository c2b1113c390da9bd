"""What the head camera sees of hands in simulated interactions, and what a detector makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.tables import simulated_detections as detecting
from wearcap.geometry.rotation import about_axis
from wearsim.recordings.interaction_session import InteractionConfig, simulate_interactions

PERFECT = detecting.Detector(found=1.0, side=1.0, state=1.0, apart=1.0, false_hands=0.0)
EVERY = 15


@pytest.fixture(scope="module")
def hands():
    """(seen, touching) of half a minute, filmed by a camera that looks down at the hands."""
    recording, flat = simulate_interactions(InteractionConfig(minutes=0.5), "session", "val", 3)
    assert recording.camera is not None
    down = about_axis("y", torch.tensor(np.deg2rad(40.0)).float())
    recording = replace(recording, camera=replace(recording.camera, R_head_cam=down @ recording.camera.R_head_cam))
    touching = recording.interactions.hand_contact(recording.camera.timestamps[::EVERY].contiguous()).numpy()
    return detecting.seen_hands(recording, flat.environment, EVERY), touching


def test_hands_are_in_the_picture_mostly_while_they_are_at_work_and_near_what_they_touch(hands):
    seen, touching = hands
    assert 0.01 < seen.inside.mean() < 0.6
    assert seen.inside[touching].mean() > seen.inside[~touching].mean()
    assert (seen.pixel[seen.inside] >= -0.5).all()
    assert (seen.pixel[seen.inside] < [960, 540]).all()
    assert seen.near[touching].mean() > 0.9
    assert seen.near.mean() < 0.9


def test_a_perfect_detector_knows_every_hand_in_sight_and_none_else(hands):
    seen, touching = hands
    frames = detecting.detections(seen, touching, PERFECT, np.random.default_rng(0), EVERY, (960, 540))
    found = np.full((len(frames), 2), -1)
    for k, frame in enumerate(frames):
        assert frame["frame"] == EVERY * k
        for row in frame["hand_dets"] or ():
            found[k, int(row[-1])] = row[5] > 0
    assert ((found >= 0) == seen.inside).all()
    assert (found[seen.inside] == touching[seen.inside]).all()


def test_a_real_detector_misses_and_mistakes_as_often_as_published():
    shape = (40_000, 2)
    many = detecting.SeenHands(np.ones((*shape, 2)), np.ones(shape, bool), np.ones(shape, bool))
    frames = detecting.detections(many, np.zeros(shape, bool), detecting.HOD, np.random.default_rng(0), 1, (960, 540))
    rows = np.array([row for frame in frames for row in frame["hand_dets"] or ()])
    assert len(rows) / (2 * shape[0]) == pytest.approx(0.905 + 0.01, abs=0.01)
    assert (rows[:, 5] > 0).mean() == pytest.approx(1 - 0.75 / 0.90, abs=0.015)
