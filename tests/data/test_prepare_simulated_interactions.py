"""`wearcap prepare simulated_interactions`: recordings with their scans and environments, resumed and split."""

from pathlib import Path

import pytest

from data_prep.shared.engine import Splits, prepare
from data_prep.simulated_interactions import simulated_interactions_tasks
from wearcap.errors import WearcapError
from wearcap.io.formats.environment import read_environment
from wearcap.io.formats.ply import read_ply
from wearcap.recording.store import RecordingStore

SPLITS = Splits.read(Path(__file__).parents[2] / "data_prep/splits/simulated.csv")


def tasks(output, recordings, **how):
    sensors = {"suit": "typical", "camera_errors": "poor", "measured": True}
    settings = {"minutes": 0.2, "fps": 30, "camera_fps": 10, "spacing_m": 0.08, "seed": 0} | sensors | how
    return simulated_interactions_tasks(SPLITS, str(output), recordings, **settings)


def test_recordings_come_with_their_scenes_and_are_current_afterwards(tmp_path):
    first = prepare(tasks(tmp_path, {"val": 1, "test": 1}), tmp_path, jobs=1)
    assert len(first.written) == 2, first.failed
    assert not first.failed
    store = RecordingStore.open(tmp_path)
    recordings = [store.load(name) for name in store.names()]
    assert len({recording.location for recording in recordings}) == 2
    assert len({recording.subject for recording in recordings}) == 2
    for recording in recordings:
        environment = read_environment(tmp_path / recording.environment)
        assert {item.name for item in environment.objects} == set(recording.object_motion)
        assert len(read_ply(tmp_path / recording.scene).points) > 5_000
    clouds = {path: path.stat().st_mtime_ns for path in tmp_path.glob("scenes/*/pointcloud.ply")}
    again = prepare(tasks(tmp_path, {"val": 1, "test": 1}), tmp_path, jobs=1)
    assert not again.written
    assert len(again.current) == 2
    other = prepare(tasks(tmp_path, {"val": 1}, minutes=0.15), tmp_path, jobs=1)
    assert len(other.written) == 1
    assert clouds == {path: path.stat().st_mtime_ns for path in clouds}, "scans are not made again"


def test_impossible_wishes_are_refused(tmp_path):
    with pytest.raises(WearcapError, match="split"):
        tasks(tmp_path, {"exam": 1})
    with pytest.raises(WearcapError, match="apart"):
        tasks(tmp_path, {"val": 1}, spacing_m=0)
