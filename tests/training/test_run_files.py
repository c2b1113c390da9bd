"""What a training run writes survives kills, a full disk and a second start: checkpoints and the log."""

import csv
import errno
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.training.loggers import RunCSVLogger, read_metrics
from wearcap.training.run import TRAINING_STATE, RunCheckpointIO, require_resumable

pytestmark = pytest.mark.usefixtures("trusted")

SAVES = """
import sys, torch
from wearcap.training.run import RunCheckpointIO
path, step = sys.argv[1], 0
while True:
    step += 1
    RunCheckpointIO(".").save_checkpoint({"step": step, "weight": torch.full((1 << 22,), float(step))}, path)
    print(step, flush=True)
"""


@pytest.mark.slow
def test_a_checkpoint_is_the_old_one_or_the_new_one_whenever_its_writer_is_killed(tmp_path):
    """Also where the folder of temporary files lies on another file system."""
    path, other = tmp_path / "last.ckpt", Path("/dev/shm")
    environment = os.environ | ({"TMPDIR": str(other)} if other.is_dir() else {})
    for wait_s in (0.004, 0.02):
        writer = subprocess.Popen([sys.executable, "-c", SAVES, str(path)], env=environment, stdout=subprocess.PIPE)
        assert writer.stdout is not None
        saved = int(writer.stdout.readline())
        time.sleep(wait_s)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        found = RunCheckpointIO(tmp_path).load_checkpoint(path)
        assert found["step"] >= saved
        assert (found["weight"] == found["step"]).all()


def test_a_full_disk_leaves_the_old_checkpoint_and_names_its_place(tmp_path, monkeypatch):
    path, files = tmp_path / "best.ckpt", RunCheckpointIO(tmp_path)
    files.save_checkpoint({"step": 1}, path)

    def full(self: Path, data: bytes) -> int:
        with open(self, "wb") as file:
            file.write(bytes(data)[:10])
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(WearcapError, match=r"best\.ckpt: the disk is full"):
        files.save_checkpoint({"step": 2}, path)
    assert files.load_checkpoint(path) == {"step": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["best.ckpt"]


def test_only_a_runs_own_checkpoints_are_removed(tmp_path):
    """A file to resume from names checkpoints of the run that wrote it; a stranger may name any file there."""
    run, other = tmp_path / "run", tmp_path / "other.ckpt"
    mine, note = run / "checkpoints/old.ckpt", run / "notes.txt"
    mine.parent.mkdir(parents=True)
    for file in (mine, note, other):
        file.write_text("x")
    for file in (mine, note, other, run / "checkpoints/../../other.ckpt", run / "none.ckpt"):
        RunCheckpointIO(run).remove_checkpoint(file)
    assert (mine.exists(), note.exists(), other.exists()) == (False, True, True)


class Runs:
    """A pickle that makes a file when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_what_cannot_be_resumed_from_is_named(tmp_path):
    weights = {"net.weight": torch.zeros(2, 2)}
    whole = dict.fromkeys(TRAINING_STATE, 0) | {"state_dict": weights}
    path, mark = tmp_path / "x.ckpt", tmp_path / "mark"

    def refusal(content) -> str:
        torch.save(content, path)
        with pytest.raises(WearcapError) as caught:
            require_resumable(path, weights)
        assert str(caught.value).startswith(f"{path}: ")
        return str(caught.value)

    torch.save(whole, path)
    require_resumable(path, weights)
    assert "without optimizer_states" in refusal({"state_dict": weights})
    assert "of this model" in refusal(whole | {"state_dict": {"net.weight": torch.zeros(3, 2)}})
    assert "more than tensors" in refusal(whole | {"callbacks": Runs(mark)})
    path.write_bytes(pickle.dumps(Runs(mark)))
    with pytest.raises(WearcapError, match="more than tensors|not a readable checkpoint"):
        require_resumable(path, weights)
    assert not mark.exists()


def log(folder: Path, resume: str | None, steps: range, flush: int = 2, **more: float) -> RunCSVLogger:
    """A run's log of some steps, without its end."""
    logger = RunCSVLogger(str(folder), resume, flush_logs_every_n_steps=flush)
    for step in steps:
        logger.log_metrics({"loss": 1 / (step + 1)} | more, step)
    return logger


def steps_of(folder: Path) -> list[int]:
    with open(folder / "metrics.csv", newline="") as file:
        return [int(row["step"]) for row in csv.DictReader(file)]


def test_a_finished_run_that_is_started_again_keeps_its_log(tmp_path):
    log(tmp_path, None, range(15)).finalize("success")
    again = RunCSVLogger(str(tmp_path), "auto")
    _ = again.experiment
    again.finalize("success")
    assert steps_of(tmp_path) == list(range(15))


def test_a_resumed_run_that_is_killed_before_it_writes_keeps_the_log(tmp_path):
    log(tmp_path, None, range(10)).finalize("success")
    log(tmp_path, "auto", range(8, 10), flush=100)  # killed: nothing was flushed
    assert steps_of(tmp_path) == list(range(10))
    log(tmp_path, "auto", range(8, 14)).finalize("success")
    assert steps_of(tmp_path) == list(range(14))


def test_a_run_from_scratch_in_an_old_folder_keeps_the_old_log_beside_its_own(tmp_path):
    log(tmp_path, None, range(6)).finalize("success")
    log(tmp_path, None, range(3)).finalize("success")
    assert steps_of(tmp_path) == [0, 1, 2]
    assert len(read_metrics(tmp_path / "metrics.previous.csv")) == 6


def test_a_new_metric_and_a_line_cut_short_lose_no_row(tmp_path):
    logger = log(tmp_path, None, range(4))
    logger.log_metrics({"val": 2.0}, 5)
    logger.finalize("success")
    with open(tmp_path / "metrics.csv", "a") as file:
        file.write("0.25,")
    log(tmp_path, "auto", range(6, 8)).finalize("success")
    rows = read_metrics(tmp_path / "metrics.csv")
    assert [int(row["step"]) for row in rows] == [0, 1, 2, 3, 5, 6, 7]
    assert rows[4] == {"step": "5", "val": "2.0"}


def test_metrics_with_an_endless_value_are_refused(tmp_path):
    (tmp_path / "metrics.csv").write_text(f"step\n{'1' * 200_000}\n")
    with pytest.raises(WearcapError, match="not a table of metrics"):
        read_metrics(tmp_path / "metrics.csv")
