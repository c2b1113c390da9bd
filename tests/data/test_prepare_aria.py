"""Aria recordings become recordings that capture, doctor and the viewer can use."""

from pathlib import Path

import pytest

from wearcap.cli import prepare as verb
from wearcap.cli.main import run_verb
from wearcap.recording import RecordingStore


@pytest.mark.real
def test_a_real_aria_recording_is_prepared_and_found_sound(real_data, tmp_path):
    assert run_verb("prepare", ["aria", f"source={real_data / 'aria_mps'}", f"output={tmp_path}", "jobs=1"]) == 0
    recording = RecordingStore.open(tmp_path).load("aria_mps")
    assert recording.head is not None
    assert recording.points is not None
    assert abs(recording.duration_s - 11.5) < 0.5
    assert len(recording.points.points_world) > 20_000
    assert run_verb("doctor", [f"{tmp_path}/aria_mps", "--quiet"]) in (0, None)


def test_a_recording_is_found_once_and_made_again_when_its_points_change(tmp_path, monkeypatch):
    """REC/mps/slam is REC's output, not that of three recordings; every file that is read counts."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    from test_aria_mps import POINTS, SEEN, rows, write

    for name in ("a", "b"):
        slam = tmp_path / "in" / name / "mps" / "slam"
        slam.mkdir(parents=True)
        write(slam / "closed_loop_trajectory.csv", rows(400))
        (slam / "semidense_points.csv").write_text(POINTS + "9,g,1,0,0,0.001,0.001\n")
    arguments = ["aria", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1"]
    verb.main(arguments)
    assert sorted(RecordingStore.open(tmp_path / "out").names()) == ["a", "b"]
    cloud = RecordingStore.open(tmp_path / "out").load("a").points
    assert cloud is not None
    assert cloud.first_seen is None
    (tmp_path / "in/a/mps/slam/semidense_observations.csv").write_text(SEEN + "9,12000000,c,1,1\n")
    verb.main(arguments)
    cloud = RecordingStore.open(tmp_path / "out").load("a").points
    assert cloud is not None
    assert cloud.first_seen is not None
    assert cloud.first_seen.tolist() == [12.0]


def test_a_folder_without_mps_output_is_named(tmp_path, capsys):
    assert run_verb("prepare", ["aria", f"source={tmp_path}", f"output={tmp_path}/out", "jobs=1"]) == 2
    assert "no MPS output" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
