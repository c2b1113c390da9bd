"""`wearcap prepare simulated`: splits that never meet, the same bytes for the same seed."""

import subprocess
import sys
from pathlib import Path

import pytest

from command_line import exit_code
from data_prep.shared.engine import Splits
from data_prep.simulated import simulated_tasks
from wearcap.cli.conf import compose, splits_dir
from wearcap.errors import WearcapError
from wearcap.files import sha256_of
from wearcap.recording import RecordingStore


def given(output: Path, *more: str) -> list[str]:
    settings = ["recordings={train:2,val:1,test:1}", "duration_s=3", "points=false", *more]
    return ["prepare", "simulated", f"output={output}", *settings]


def prepare(output: Path, *more: str) -> RecordingStore:
    """As a user would, in a process of its own."""
    command = [sys.executable, "-m", "wearcap.cli.main", *given(output, *more)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return RecordingStore.open(output)


def prepare_here(output: Path, *more: str) -> RecordingStore:
    assert exit_code(given(output, *more)) == 0
    return RecordingStore.open(output)


@pytest.mark.slow
def test_a_small_set(tmp_path):
    store = prepare(tmp_path / "a", "jobs=1")
    assert [len(store.names(split)) for split in ("train", "val", "test")] == [2, 1, 1]
    for kind in ("subject", "location"):
        people = [{getattr(store.entries[n].context, kind) for n in store.names(s)} for s in ("train", "val", "test")]
        assert not people[0] & people[1]
        assert not people[0] & people[2]
        assert not people[1] & people[2]
    recording = store.load(store.names("train")[0])
    assert recording.motion is not None
    assert recording.head is not None
    assert recording.contacts is not None
    assert recording.floor is not None
    assert (len(recording.motion), recording.imu.keys()) == (180, {"left_wrist", "right_wrist"})
    with_two = prepare_here(tmp_path / "b", "jobs=2", "backend=threading")
    assert {n: e.sha256 for n, e in with_two.entries.items()} == {n: e.sha256 for n, e in store.entries.items()}
    manifest = sha256_of(store.manifest_path)
    prepare_here(tmp_path / "a", "jobs=1")
    assert sha256_of(store.manifest_path) == manifest


def test_wrong_settings_are_refused():
    splits = Splits.read(splits_dir() / "simulated.csv")
    for wrong in ({"fps": 0}, {"duration_s": -1}, {"recordings": {"trian": 1}}):
        right = {"recordings": {"train": 1}, "duration_s": 3, "fps": 60, "points": False, "activities": None, "seed": 0}
        with pytest.raises(WearcapError):
            simulated_tasks(splits, **(right | wrong))


def test_presets_say_how_much_they_make():
    minutes = {}
    for preset in ("quick", "standard"):
        config = compose("prepare", ["prepare=simulated", f"preset={preset}"])
        minutes[preset] = sum(config.recordings.values()) * config.duration_s / 60
    assert minutes == {"quick": 6, "standard": 300}


def test_splits_that_disagree_with_the_simulator_are_refused(tmp_path):
    (tmp_path / "s.csv").write_text("subject,split\n*,train\n")
    with pytest.raises(WearcapError, match="simulated val split are listed elsewhere"):
        simulated_tasks(Splits.read(tmp_path / "s.csv"), {"val": 1}, 3, 60, False, None, 0)
