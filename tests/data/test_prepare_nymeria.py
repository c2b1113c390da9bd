"""Nymeria's folders to a data set."""

import json
from pathlib import Path

import pytest

from wearcap.cli import prepare as verb
from wearcap.errors import WearcapError
from wearcap.recording import RecordingStore


def test_sequences_become_recordings(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    from test_nymeria import write_sequence

    name = "20230607_s0_james_johnson_act0_e72nhq"
    write_sequence(tmp_path / "in" / name)
    content = {"fake_name": "james_johnson", "location": "house_3", "script": "cooking"}
    (tmp_path / "in" / name / "metadata.json").write_text(json.dumps(content))
    arguments = ["nymeria", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1"]
    verb.main(arguments)
    store = RecordingStore.open(tmp_path / "out")
    entry = store.entries[name]
    assert (entry.subject, entry.location, entry.activity) == ("james_johnson", "house_3", "cooking")
    assert entry.fps == 60.0
    recording = store.load(name)
    assert recording.head is not None
    assert recording.contacts is not None
    written = entry.sha256
    verb.main(arguments)
    assert RecordingStore.open(tmp_path / "out").entries[name].sha256 == written


def test_a_folder_without_sequences_is_refused(tmp_path):
    with pytest.raises(WearcapError, match="no sequences"):
        verb.main(["nymeria", f"source={tmp_path}", f"output={tmp_path / 'out'}"])
