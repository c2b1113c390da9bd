"""The doctor of a data set, and the end of a preparation, report its people by name."""

import json
import math
from dataclasses import replace

import pytest
import torch

from data_prep.shared.engine import Report
from walking_person import sound_recording
from wearcap.apps.doctor import examine
from wearcap.checks import truth as doctor_truth
from wearcap.checks.truth import FIGURES, of_person, people
from wearcap.cli import prepare
from wearcap.cli.doctor import main
from wearcap.recording import Recording, RecordingStore


@pytest.fixture(scope="module")
def walk() -> Recording:
    return sound_recording(8.0)


def lifted(recording: Recording, height: float) -> Recording:
    motion = recording.motion
    t = motion.t_world_root + torch.tensor([0.0, 0.0, height])
    return replace(recording, motion=replace(motion, t_world_root=t))


@pytest.fixture
def store(walk, tmp_path) -> RecordingStore:
    """Anna walks on the floor, Bert 3 cm over it; of somebody there is a head alone."""
    store = RecordingStore(tmp_path / "walks")
    for name, subject, height in (("a1", "Anna", 0.0), ("a2", "Anna", 0.0), ("b1", "Bert", 0.03)):
        store.add(replace(lifted(walk, height), name=name, subject=subject), split="train", config_hash="")
    head = replace(walk, name="c", subject="Carl", motion=None, contacts=None, skeleton=None)
    store.add(head, split="train", config_hash="")
    return store


SOLES = "planted soles are not on the floor"


def test_people_without_a_body_are_left_out(store):
    found = people(store, store.names())
    assert list(found) == ["Anna", "Bert"]
    assert SOLES not in {finding.what for finding in of_person(found["Anna"])}
    (soles,) = (finding for finding in of_person(found["Bert"]) if finding.what == SOLES)
    assert soles.severity == "warning"
    assert soles.evidence == "sole cm: 3.0, people's -1.5…1.5"


def test_a_sample_is_short_and_spread_over_the_recordings(store, monkeypatch):
    monkeypatch.setattr(doctor_truth, "SAMPLE_S", 4.0)
    monkeypatch.setattr(doctor_truth, "CUT_S", 2.0)
    seen, truth = [], doctor_truth.truth
    monkeypatch.setattr(doctor_truth, "truth", lambda cuts: seen.append(cuts) or truth(cuts))
    people(store, store.names())
    anna, bert = seen
    assert [cut.name for cut in anna] == ["a1", "a2"]
    for cuts, seconds, middle in ((anna, 2.0, 4.0), (bert, 4.0, 4.0)):
        for cut in cuts:
            times = cut.motion.timestamps
            assert (times[-1] - times[0]).item() == pytest.approx(seconds, abs=0.05)
            assert times.mean().item() == pytest.approx(middle, abs=0.05)
            assert len(cut.motion.R_parent_joint) == len(times)


def test_the_doctor_reports_people_of_sound_recordings(store, capsys):
    path = store.path_of("a2")
    path.write_bytes(path.read_bytes()[:1000])
    report = examine(store.root)
    assert list(report.findings) == ["a1", "a2", "b1", "c", "person Anna", "person Bert"]
    assert report.people["Anna"]["minutes"] == pytest.approx(8 / 60, abs=0.001)
    assert SOLES in {finding.what for finding in report.findings["person Bert"]}
    assert examine(lifted(store.load("b1"), 0.0)).people == {}
    with pytest.raises(SystemExit):
        main([str(store.root), "--json"])
    shown = json.loads(capsys.readouterr().out)["people"]
    assert shown["Bert"]["sole_cm"] == pytest.approx(3.0, abs=0.1)
    assert "standing_deg" not in shown["Bert"], "nobody stands"
    with pytest.raises(SystemExit):
        main([str(store.root)])
    out = capsys.readouterr().out
    assert "4 recordings" in out
    assert "Anna" in out


def test_a_preparation_ends_with_warnings_on_people_whose_recordings_are_new(store, capsys):
    prepare._show_report(Report(written=["b1"], current=["a1", "a2", "c"]), store)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert len(lines) == 1
    assert lines[0].startswith("warning: person Bert: ")
    assert f"{SOLES} (sole cm: 3.0, people's -1.5…1.5)" in lines[0]
    prepare._show_report(Report(current=["a1", "b1"]), store)
    assert "warning" not in capsys.readouterr().out


def test_bounds_hold_what_they_say():
    for figure in FIGURES:
        assert not figure.is_odd({})
        for bound, out in ((figure.low, -0.01), (figure.high, 0.01)):
            assert not figure.is_odd({figure.name: bound})
            assert figure.is_odd({figure.name: bound + out}) == math.isfinite(bound)
