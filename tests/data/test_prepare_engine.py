"""The preparation engine: same bytes however it runs, resumes after a kill, one failure stops nothing."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from prepare_tasks import tasks

from data_prep.shared.engine import Splits, prepare
from wearcap.errors import WearcapError
from wearcap.files import content_hash, sha256_of
from wearcap.recording import RecordingStore


def digests(root: Path) -> dict[str, str]:
    return {path.relative_to(root).as_posix(): sha256_of(path) for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """Eight recordings made one after another in this process."""
    root = tmp_path_factory.mktemp("alone")
    prepare(tasks(8), root, jobs=1)
    return root


def test_a_run_writes_what_it_reports(alone):
    store = RecordingStore.open(alone)
    assert store.names("train") == [f"r{index:02}" for index in range(8)]
    assert all(wrong is None for _, wrong in store.verify())
    assert store.entries["r00"].fps == 60.0
    assert len(digests(alone)) == 9


@pytest.mark.parametrize("backend", ["loky", "threading"])
def test_workers_give_the_same_bytes(alone, tmp_path, backend):
    prepare(tasks(8), tmp_path, jobs=2, backend=backend)
    assert digests(tmp_path) == digests(alone)


@pytest.mark.slow
def test_two_dask_workers_give_the_same_bytes(alone, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # where dask's workers find the tasks
    prepare(tasks(8), tmp_path, jobs=2, backend="dask")
    assert digests(tmp_path) == digests(alone)


def test_a_second_run_does_nothing_and_a_damaged_file_is_made_again(tmp_path):
    assert len(prepare(tasks(3), tmp_path, jobs=1).written) == 3
    before = digests(tmp_path)
    assert prepare(tasks(3), tmp_path, jobs=1).current == ["r00", "r01", "r02"]
    file = tmp_path / "recordings/r01.safetensors"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    report = prepare(tasks(3), tmp_path, jobs=1)
    assert (report.written, report.current) == (["r01"], ["r00", "r02"])
    assert digests(tmp_path) == before


def test_changed_settings_and_overwrite_make_recordings_again(tmp_path):
    first = tasks(2)
    prepare(first, tmp_path, jobs=1)
    changed = [first[0], replace(first[1], hash=content_hash("other"))]
    assert prepare(changed, tmp_path, jobs=1).written == ["r01"]
    assert len(prepare(changed, tmp_path, jobs=1, overwrite=True).written) == 2
    moved = [replace(changed[0], split="test"), changed[1]]
    assert prepare(moved, tmp_path, jobs=1).written == ["r00"]
    assert RecordingStore(tmp_path).names("test") == ["r00"]


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("refused", "r01.amc: cut short"),
        ("bug", "ZeroDivisionError"),
        ("nan", "r01: 1 values of motion.t_world_root are not finite, the first in row 7"),
        ("still", "motion.timestamps do not rise at row 1 .frame rate 0"),
        ("short", "motion has 3 frames"),
        ("sheared", "1 matrices of motion.R_parent_joint are no rotations"),
    ],
)
def test_one_bad_recording_is_named_and_the_rest_goes_on(tmp_path, fault, reason):
    report = prepare(tasks(3, r01=fault), tmp_path, jobs=1)
    assert report.written == ["r00", "r02"]
    assert list(report.failed) == ["r01"]
    assert re.search(reason, report.failed["r01"])
    assert RecordingStore(tmp_path).names() == ["r00", "r02"]
    assert not (tmp_path / "recordings/r01.safetensors").exists()


def test_a_kill_in_the_middle_is_resumed(alone, tmp_path):
    script = Path(__file__).parent / "prepare_tasks.py"
    process = subprocess.Popen([sys.executable, script, tmp_path, "8", "0.5"])
    deadline = time.monotonic() + 60
    while len(list(tmp_path.glob("recordings/*.safetensors"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    (tmp_path / "recordings/.r07.tmp-0123abcd.safetensors").write_bytes(b"half")
    report = prepare(tasks(8), tmp_path, jobs=1)
    assert report.current
    assert report.written
    assert digests(tmp_path) == digests(alone)


def test_a_killed_worker_is_reported_and_the_next_run_goes_on(alone, tmp_path):
    with pytest.raises(WearcapError, match=r"a worker process was killed.*fewer jobs"):
        prepare(tasks(8, r05="killed"), tmp_path, jobs=2)
    assert all(wrong is None for _, wrong in RecordingStore.open(tmp_path).verify())
    prepare(tasks(8), tmp_path, jobs=1)
    assert digests(tmp_path) == digests(alone)


def test_a_full_disk_stops_the_run_with_one_message(tmp_path, monkeypatch):
    prepare(tasks(1), tmp_path, jobs=1)
    write = Path.write_bytes

    def full(path, content):
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(WearcapError, match=r"r01\.safetensors: the disk is full"):
        prepare(tasks(3), tmp_path, jobs=1)
    monkeypatch.undo()
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["manifest.json", "r00.safetensors"]
    assert RecordingStore.open(tmp_path).names() == ["r00"]


def test_no_permission_is_reported_before_any_work(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(WearcapError, match="no permission to write here"):
        prepare(tasks(1), tmp_path / "new", jobs=1)
    monkeypatch.undo()
    assert not list((tmp_path / "new").iterdir())


def test_an_output_below_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WearcapError, match="cannot be written"):
        prepare(tasks(1), tmp_path / "file" / "set", jobs=1)


def test_wrong_requests_are_refused(tmp_path):
    with pytest.raises(WearcapError, match="nothing to prepare"):
        prepare([], tmp_path)
    with pytest.raises(WearcapError, match="two sources give a recording the name 'r00'"):
        prepare([*tasks(1), *tasks(1)], tmp_path)
    with pytest.raises(WearcapError, match="0 jobs"):
        prepare(tasks(1), tmp_path, jobs=0)
    with pytest.raises(WearcapError, match="no backend 'lokky'"):
        prepare(tasks(1), tmp_path, backend="lokky")


def test_split_lists(tmp_path):
    path = tmp_path / "splits.csv"
    path.write_text("# a comment\nsubject,split\n14,train\nHumanEva/*,val\n9,test\n")
    splits = Splits.read(path)
    assert [splits.of(subject) for subject in ("14", "HumanEva/S1", "9")] == ["train", "val", "test"]
    with pytest.raises(WearcapError, match="subject '10' is in no split"):
        splits.of("10")
    path.write_text("subject,split\n*,hash\n")
    shares = [Splits.read(path).of(f"person_{number}") for number in range(2000)]
    assert shares.count("test") / 2000 == pytest.approx(0.15, abs=0.03)
    assert shares.count("val") / 2000 == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize(
    "text", ["", "subject\n14\n", "subject,split\n14,trian\n", "subject,split\n14\n", "subject,split,x\n1,test,3\n"]
)
def test_broken_split_lists_are_refused(tmp_path, text):
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(WearcapError, match=r"s\.csv"):
        Splits.read(tmp_path / "s.csv")
