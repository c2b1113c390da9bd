"""`wearcap prepare simulated_hps`: recordings with their scenes and videos, resumable, by splits."""

from pathlib import Path

import pytest
from hydra.utils import instantiate

from data_prep.shared.engine import Splits, prepare
from data_prep.simulated_hps import simulated_hps_tasks
from wearcap.cli.conf import compose, splits_dir
from wearcap.errors import WearcapError
from wearcap.io.formats.camera_json import read_photos
from wearcap.recording.store import RecordingStore


def tasks_of(root: Path, **changes):
    settings = {
        "recordings": {"test": 1},
        "fps": 60,
        "camera_fps": 30,
        "suit": "typical",
        "camera_errors": "typical",
        "returns_m": [],
        "end_m": 15,
        "spacing_m": 0.4,
        "photo_m": 14.0,
        "video_s": 0.8,
        "video_fps": 5,
        "changed": 0.3,
        "seed": 0,
    }
    return simulated_hps_tasks(Splits.read(splits_dir() / "simulated.csv"), str(root), **(settings | changes))


def test_a_data_set_is_made_and_then_left_alone(tmp_path):
    tasks = tasks_of(tmp_path)
    report = prepare(tasks, tmp_path, jobs=1, backend="threading")
    assert not report.failed
    recording = RecordingStore.open(tmp_path).load(tasks[0].name)
    assert recording.scene == f"scenes/{recording.location}/pointcloud.ply"
    assert (tmp_path / recording.scene).is_file()
    photos = read_photos((tmp_path / recording.scene).parent)
    assert photos
    assert all(photo.file.is_file() for photo in photos)
    assert len(recording.camera.timestamps) == 4
    assert (tmp_path / recording.camera.video).stat().st_size > 10_000
    assert recording.intervals.names == ("stand", "move")
    again = prepare(tasks, tmp_path, jobs=1, backend="threading")
    assert again.current == [tasks[0].name]


def test_settings_change_the_hash(tmp_path):
    hashes = {
        tasks_of(tmp_path, **change)[0].hash
        for change in ({}, {"photo_m": 3.0}, {"changed": 0.0}, {"end_m": 20}, {"video_s": None}, {"spacing_m": None})
    }
    assert len(hashes) == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"returns_m": [80, 70]}, "rise"),
        ({"end_m": 0}, "rise"),
        ({"recordings": {"exam": 1}}, "exam"),
        ({"camera_fps": 0}, "Hz"),
    ],
)
def test_wrong_settings_are_refused(tmp_path, change, message):
    with pytest.raises(WearcapError, match=message):
        tasks_of(tmp_path, **change)


@pytest.mark.parametrize("preset", ["quick", "standard"])
def test_the_presets_make_tasks(preset, tmp_path):
    config = compose("prepare", ["prepare=simulated_hps", f"preset={preset}", f"output={tmp_path}"])
    tasks = instantiate(config.tasks, _convert_="all", _partial_=True)(splits=Splits.read(splits_dir() / config.splits))
    assert {task.split for task in tasks} <= {"train", "val", "test"}
    assert len({task.name for task in tasks}) == len(tasks) >= 1
