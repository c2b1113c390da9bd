"""`prepare markers` and `prepare ui_prmd`: recordings of people whose markers were seen."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate

from data_prep.shared.engine import NOTE, Splits, Task, check_recording, prepare
from marker_person import markers_of, person, squats, write_trc
from wearcap.cli.conf import compose, splits_dir
from wearcap.errors import WearcapError
from wearcap.metrics.gait import knee_deg, standing
from wearcap.recording import RecordingStore


def tasks(source: str, folder: Path, *given: str) -> list[Task]:
    config = compose("prepare", [f"prepare={source}", f"source={folder}", *given])
    splits = Splits.read(splits_dir() / f"{source}.csv")
    return instantiate(config.tasks, _convert_="all", _partial_=True)(splits=splits)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("markers")
    for who, height in (("anna", 1.62), ("ben", 1.80)):
        for number, seconds in enumerate((2.0, 3.0)):
            write_trc(markers_of(squats(person(1.0, height), seconds), number), root / who / f"squat {number}.trc")
    return root


def test_trc_files_become_recordings(folder, tmp_path):
    report = prepare(tasks("markers", folder, "activity=(squat)"), tmp_path, jobs=1)
    assert not report.failed
    assert len(report.written) == 4
    store = RecordingStore(tmp_path)
    one, other = (store.load(f"{who}__squat_0") for who in ("anna", "ben"))
    check_recording(one)
    assert (one.subject, one.activity, one.source) == ("anna", "squat", "markers")
    assert one.motion is not None
    assert other.motion is not None
    assert one.contacts is not None
    assert one.floor is not None
    assert other.motion.skeleton.stature / one.motion.skeleton.stature == pytest.approx(1.80 / 1.62, abs=0.02)
    assert float(one.motion.provenance["markers_rms_m"]) < 0.01
    assert knee_deg(one.motion).max() > 85
    assert one.contacts.contact.float().mean() > 0.9


def test_settings_and_files_change_the_hash(folder):
    plain, other = tasks("markers", folder), tasks("markers", folder, "unit=mm")
    assert [task.name for task in plain] == [task.name for task in other]
    assert not {task.hash for task in plain} & {task.hash for task in other}


def test_markers_that_are_not_known_are_noted(tmp_path):
    seen = markers_of(squats(person(), 2.0))
    names = tuple("stick" if name == "RBAK" else name for name in seen.names)
    write_trc(type(seen)(seen.timestamps, names, seen.t_world_marker), tmp_path / "a.trc")
    (task,) = tasks("markers", tmp_path, "subject=anna")
    motion = task.make().motion
    assert motion is not None
    assert "stick" in motion.provenance[NOTE]


def test_wrong_settings_are_named(folder, tmp_path):
    with pytest.raises(WearcapError, match="subject"):
        tasks("markers", folder, "subject=(nobody)")
    with pytest.raises(WearcapError, match="trc"):
        tasks("markers", tmp_path)


@pytest.mark.real
def test_people_of_ui_prmd_stand_straight(real_data):
    """Trials of the validation person: markers within 1.5 cm, knees while standing at 0 to 8°, squats bend them by 80°."""
    chosen = [task for task in tasks("ui_prmd", real_data / "ui_prmd") if task.split == "val" and "_e02" in task.name]
    shown = {
        task.name.split("__")[-1][:3]: task.make() for task in chosen if task.name.split("__")[-1][:3] in ("m01", "m08")
    }
    assert shown["m01"].activity == "deep squat"
    knees = []
    for recording in shown.values():
        assert recording.motion is not None
        assert float(recording.motion.provenance["markers_rms_m"]) < 0.015
        knees.append(knee_deg(recording.motion)[standing(recording.motion)])
    assert 0 < torch.cat(knees).median() < 8
    assert knee_deg(shown["m01"].motion).max() > 80
