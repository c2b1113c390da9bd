"""Baselines scored as pipelines on whole recordings."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.evaluation.baselines import MeanPose, NearestWindow
from wearcap.evaluation.evaluate import evaluate
from wearcap.metrics.scores import score
from wearcap.metrics.table import aggregate
from wearcap.recording import ContactTrack
from wearcap_testing import recording_of, small_dataset, swaying_motion


def test_baselines_are_pipelines(tmp_path):
    store = small_dataset(tmp_path)
    for baseline in (MeanPose.fit([store]), NearestWindow.fit([store])):
        rows = list(evaluate(baseline, store, store.names("test"), [0]))
        assert [row.recording for row in rows] == sorted(store.names("test"), key=lambda n: store.entries[n].frames)
        assert 0 < aggregate(rows)["mpjpe_cm"].mean < 100


def test_nearest_window_knows_its_training_data(tmp_path):
    store = small_dataset(tmp_path)
    baseline = NearestWindow.fit([store], stride_s=1 / 60)
    rows = {row.recording: row for row in evaluate(baseline, store, store.names(), [0])}
    seen = [rows[name].scores["mpjpe_cm"] for name in store.names("train")]
    unseen = [rows[name].scores["mpjpe_cm"] for name in store.names("test")]
    assert max(seen) < 0.05
    assert min(unseen) > 1


def test_foot_contact_is_found_by_name_among_other_parts():
    motion = swaying_motion(120)
    recording = recording_of(motion, "r")
    parts = ("left_hand", *reversed(FOOT_PATCHES))
    contact = torch.zeros(120, 5, dtype=torch.bool)
    contact[:, parts.index("right_heel")] = True
    track = ContactTrack(motion.timestamps, parts, contact)
    plain = torch.zeros(120, 4, dtype=torch.bool)
    plain[:, FOOT_PATCHES.index("right_heel")] = True
    same = ContactTrack(motion.timestamps, FOOT_PATCHES, plain)
    found = [score(motion, replace(recording, contacts=t), "r", 0).scores["foot_skate_cm_s"] for t in (track, same)]
    assert found[0] == pytest.approx(found[1])
    assert found[0] > 0
