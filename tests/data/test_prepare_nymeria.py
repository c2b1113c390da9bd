"""Nymeria's folders to a data set."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from data_prep import aria_vrs
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
    assert (entry.context.subject, entry.context.location, entry.context.activity) == (
        "james_johnson",
        "house_3",
        "cooking",
    )
    assert entry.fps == 60.0
    recording = store.load(name)
    assert recording.head is not None
    assert recording.contacts is not None
    written = entry.sha256
    verb.main(arguments)
    assert RecordingStore.open(tmp_path / "out").entries[name].sha256 == written


def test_a_sequence_with_its_own_recording_brings_a_video(tmp_path, monkeypatch):
    """`camera=true` films what was recorded while suit and device ran, with the camera where the aligned device sits."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    from test_aria_vrs import Recorder
    from test_nymeria import OFFSET_S, write_sequence

    fake = Recorder(frames=2400, start_ns=int((995 + OFFSET_S) * 1e9))
    for name in ("data_provider", "aria_calibration"):
        monkeypatch.setattr(aria_vrs, name, fake, raising=False)
    monkeypatch.setattr(aria_vrs, "TimeDomain", SimpleNamespace(DEVICE_TIME=0), raising=False)
    drawn = []
    monkeypatch.setattr(aria_vrs, "write_frames", lambda file, frames, fps: drawn.append((file, fps)))
    folder = write_sequence(tmp_path / "in" / "20230607_s0_ada_byron_act0_e72nhq")
    arguments = ["nymeria", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1", "camera=true"]
    verb.main(arguments)
    assert RecordingStore.open(tmp_path / "out").load(folder.name).camera is None, "nothing was downloaded"
    (folder / "recording_head" / "data").mkdir()
    (folder / "recording_head" / "data" / "data.vrs").write_bytes(b"a stand-in is read instead")
    verb.main(arguments)
    recording = RecordingStore.open(tmp_path / "out").load(folder.name)
    camera, head = recording.camera, recording.head
    assert camera is not None
    assert head is not None
    assert camera.video == f"videos/{folder.name}.mp4"
    assert [(file, round(fps)) for file, fps in drawn] == [(tmp_path / "out" / camera.video, 30)]
    assert head.timestamps[0] <= camera.timestamps[0] < head.timestamps[0] + 0.04
    assert head.timestamps[-1] - 0.04 < camera.timestamps[-1] <= head.timestamps[-1]
    assert (camera.t_head_cam - head.t_head_device).norm() < 0.12


def test_a_folder_without_sequences_is_refused(tmp_path):
    with pytest.raises(WearcapError, match="no sequences"):
        verb.main(["nymeria", f"source={tmp_path}", f"output={tmp_path / 'out'}"])
