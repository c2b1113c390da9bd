"""The siege of a live capture, at its smallest: nothing of the devices is lost."""

import pytest

from benchmarks.faults import live_siege
from wearcap.recording.store import save_recording
from wearcap_testing import recording_of, swaying_motion


@pytest.mark.slow
def test_devices_are_served_beside_silent_sockets_and_floods(tmp_path, monkeypatch):
    save_recording(recording_of(swaying_motion(200, 0), "sway"), tmp_path / "in.safetensors")
    row = live_siege.siege("hmd2", 0.1, 100, 50.0, str(tmp_path / "in.safetensors"))
    assert (row["adapter"], row["sent"], row["sessions"]) == ("kept", 360, 1)
    assert row["posts"][0] == row["posts"][1] > 0
    assert row["frames"] == row["recorded"] > 300
    assert row["lines"] < live_siege.LINES
