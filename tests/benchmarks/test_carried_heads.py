"""Heads that are carried lower than in the rest pose by a planted share are measured so, by person."""

from dataclasses import replace

import pytest
import torch

from benchmarks import carried_heads
from standing_person import acting
from wearcap.recording import RecordingStore
from wearcap_testing import recording_of

PEOPLE = {"anna": 0.97, "ben": 0.99, "cleo": 0.98}


def test_shares_by_person(tmp_path, monkeypatch):
    store = RecordingStore(tmp_path / "set")
    for person, share in PEOPLE.items():
        motion = acting(1.7, [("stand", 4.0), ("walk", 12.0)])
        low = torch.tensor([0.0, 0.0, (share - 1) * motion.skeleton.height_of("head")])
        motion = replace(motion, t_world_root=motion.t_world_root + low)
        store.add(recording_of(motion, person, subject=person), split="train", config_hash="")
    found = carried_heads.by_person(tmp_path / "set", None)
    assert found.keys() == PEOPLE.keys()
    for person, share in PEOPLE.items():
        assert found[person] == {kind: pytest.approx(share, abs=0.008) for kind in carried_heads.KINDS}
    shorter = carried_heads.by_person(tmp_path / "set", None, legs=0.9)
    assert shorter["anna"]["standing"] > found["anna"]["standing"] + 0.04
    monkeypatch.chdir(tmp_path)
    (tmp_path / "datasets").symlink_to(tmp_path)
    figures = carried_heads.measure(("set",))
    assert [figure["value"] for figure in figures] == [pytest.approx(0.98, abs=0.007)] * 4
