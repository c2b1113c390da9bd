"""`wearcap prepare simulated_objects`: recordings with their environments, resumed and split."""

from pathlib import Path

import pytest

from data_prep.shared.engine import Splits, prepare
from data_prep.simulated_objects import simulated_objects_tasks
from wearcap.errors import WearcapError
from wearcap.io.formats.environment import read_environment
from wearcap.recording.store import RecordingStore

SPLITS = Splits.read(Path(__file__).parents[2] / "data_prep/splits/simulated.csv")


def tasks(output, recordings, **how):
    return simulated_objects_tasks(SPLITS, str(output), recordings, **({"minutes": 0.15, "fps": 30, "seed": 0} | how))


def test_recordings_come_with_their_environments_and_are_current_afterwards(tmp_path):
    first = prepare(tasks(tmp_path, {"val": 1, "test": 1}), tmp_path, jobs=1)
    assert len(first.written) == 2, first.failed
    store = RecordingStore.open(tmp_path)
    recordings = [store.load(name) for name in store.names()]
    assert len({recording.location for recording in recordings}) == 2
    for recording in recordings:
        environment = read_environment(tmp_path / recording.environment)
        assert {item.name for item in environment.objects} == set(recording.object_motion)
        assert recording.head is not None
        assert recording.scene is None
    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob("scenes/*/environment.json")}
    again = prepare(tasks(tmp_path, {"val": 1, "test": 1}), tmp_path, jobs=1)
    assert not again.written
    assert len(again.current) == 2
    other = prepare(tasks(tmp_path, {"val": 1}, minutes=0.1), tmp_path, jobs=1)
    assert len(other.written) == 1
    assert written == {path: path.stat().st_mtime_ns for path in written}, "environments are not made again"


def test_impossible_wishes_are_refused(tmp_path):
    with pytest.raises(WearcapError, match="split"):
        tasks(tmp_path, {"exam": 1})
