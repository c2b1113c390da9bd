"""Aria recordings become recordings that capture, doctor and the viewer can use."""

import pytest

from wearcap.cli.main import run_verb
from wearcap.recording import RecordingStore


@pytest.mark.real
def test_a_real_aria_recording_is_prepared_and_found_sound(real_data, tmp_path):
    assert (
        run_verb("prepare", ["aria", f"source={real_data / 'aria_mps'}", f"output={tmp_path}", "jobs=1"]) == 0
    )
    recording = RecordingStore.open(tmp_path).load("aria_mps")
    assert recording.head is not None
    assert recording.points is not None
    assert abs(recording.duration_s - 11.5) < 0.5
    assert len(recording.points.points_world) > 20_000
    assert run_verb("doctor", [f"{tmp_path}/aria_mps", "--quiet"]) in (0, None)


def test_a_folder_without_mps_output_is_named(tmp_path, capsys):
    assert run_verb("prepare", ["aria", f"source={tmp_path}", f"output={tmp_path}/out", "jobs=1"]) == 2
    assert "no MPS output" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
