"""What is lost when a writer is killed: prepare, train, capture, export and annotate, at random moments.

Each writer works in a process of its own that is killed (SIGKILL) and started again in the same folder, with TMPDIR on
another file system where there is one (/dev/shm). After every kill each file must be whole, and nothing may be older than
what the writer had finished before. value: kills after which something was lost; baseline: all kills; ratio = value /
baseline, to be 0. Kills that came before the writer's first write, or after its end, are not counted.
"""

import contextlib
import json
import multiprocessing
import os
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from rich.progress import track

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))

from benchmarks.speed.figures import figure
from data_prep.shared.engine import Task, prepare
from own_bvh import read_bvh
from wearcap.apps.annotate.takes import AnnotationFile
from wearcap.cli import capture, export, train
from wearcap.export.files import open_exported
from wearcap.io.formats.contact_labels import LabelClock
from wearcap.io.formats.motion_npz import read_motion
from wearcap.models.checkpoint import read_checkpoint, read_run_file
from wearcap.recording import RecordingStore
from wearcap.training.loggers import read_metrics
from wearcap.training.run import RunCheckpointIO
from wearcap_testing import recording_of, small_dataset, swaying_motion

FORK = multiprocessing.get_context("fork")
START_S = 120.0
RECORDINGS, FRAMES = 40, 240
CLOCK = LabelClock.of("r0", torch.arange(100_000, dtype=torch.float64) / 60)
Finished = Callable[[int], None]
"""Called by a writer with a number that grows, after each write that it has finished."""


@dataclass(frozen=True)
class Writer:
    """What writes into a folder until it is killed, and what looks at the folder afterwards."""

    write: Callable[[Path, Finished], None]
    check: Callable[[Path, int], None]
    """Raises when a file is damaged, or older than the last number that was finished."""
    within_s: float
    """Longest time from the first write to the kill."""


def _recording(number: int):
    return recording_of(swaying_motion(FRAMES, number), f"r{number:02}")


def _prepare(folder: Path, finished: Finished) -> None:
    """Settings change from round to round, so that every round writes all recordings anew."""
    done = _registered(folder)
    for turn in range(done // RECORDINGS, 1_000_000):
        tasks = [Task(f"r{k:02}", partial(_recording, k), "train", f"{turn:06}") for k in range(RECORDINGS)]
        prepare(tasks, folder, jobs=1)
        finished(RECORDINGS * (turn + 1))


def _registered(folder: Path) -> int:
    """Recordings that were made in whole rounds, and in the round that goes on."""
    if not (folder / "manifest.json").is_file():
        return 0
    turns = [int(entry.config_hash) for entry in RecordingStore.open(folder).entries.values()]
    return sum(turn + 1 for turn in turns)


def _check_prepared(folder: Path, least: int) -> None:
    """Files of the manifest are whole, but for those that were replaced and not registered yet: these are whole, too."""
    store = RecordingStore.open(folder)
    assert _registered(folder) >= least
    whole = {f"r{k:02}": _recording(k) for k in range(0, RECORDINGS, 13)}
    for name, wrong in store.verify():
        assert wrong is None, wrong
        if name in whole:
            assert torch.equal(store.load(name).motion.R_parent_joint, whole[name].motion.R_parent_joint)


def _train(folder: Path, finished: Finished) -> None:
    data = folder.with_name("data")
    small = ["width=32", "layers=1", "heads=4", "feedforward=32"]
    save = RunCheckpointIO.save_checkpoint

    def saved(self, checkpoint, path, storage_options=None) -> None:
        save(self, checkpoint, path, storage_options)
        if Path(path).stem == "last":
            finished(checkpoint["global_step"])

    RunCheckpointIO.save_checkpoint = saved
    train.main(
        [
            "experiment=motion_diffusion_head",
            f"data.sources.simulated.root={data}",
            "debug=fast",
            "callbacks.capture=null",
            f"hydra.run.dir={folder}",
            f"paths.outputs={folder.parent}",
            "data.dataset.window=60",
            "trainer.accelerator=cpu",
            "trainer.max_steps=100000000",
            "logger.csv.flush_logs_every_n_steps=1",
            "trainer.log_every_n_steps=1",
            "trainer.enable_progress_bar=false",
            "trainer.enable_model_summary=false",
            "callbacks.progress=null",
            "resume=auto",
            *(f"model.net.{part}" for part in small),
        ]
    )


def _saved_step(folder: Path) -> int:
    path = folder / "checkpoints" / "last.ckpt"
    return read_run_file(path)["global_step"] if path.is_file() else 0


def _check_trained(folder: Path, least: int) -> None:
    step = _saved_step(folder)
    assert step >= least
    best = folder / "checkpoints" / "best.ckpt"
    if step:
        read_checkpoint(folder / "checkpoints" / "last.ckpt")
        read_checkpoint(best)
        logged = {int(row["step"]) for row in read_metrics(folder / "metrics.csv")}
        # Lightning logs a step after it is made; the rows of what a checkpoint holds are written before the checkpoint.
        assert logged >= set(range(step - 1)), f"rows up to {max(logged)} for step {step}"


def _capture(folder: Path, finished: Finished) -> None:
    data, turn = folder.with_name("data"), 0
    while True:
        with contextlib.redirect_stdout(None):
            capture.main(
                [
                    "pipeline=hmd2",
                    "checkpoint=hmd2",
                    "pipeline.sampling.steps=1",
                    f"recording={data}/r2",
                    "video=false",
                    f"hydra.run.dir={folder}",
                    "body=false",
                ]
            )
        turn += 1
        finished(turn)


def _check_captured(folder: Path, least: int) -> None:
    if least or (folder / "motion.npz").exists():
        assert len(read_motion(folder / "motion.npz"))
    if least or (folder / "motion.bvh").exists():
        assert len(read_bvh(folder / "motion.bvh"))
    if least or (folder / "motion.glb").exists():
        size = (folder / "motion.glb").stat().st_size
        assert int.from_bytes((folder / "motion.glb").read_bytes()[8:12], "little") == size


def _export(folder: Path, finished: Finished) -> None:
    turn = 0
    while True:
        for name in ("contact_sequence", "hmd2"):
            shared = f"output={folder}/{name}.safetensors"
            with contextlib.redirect_stdout(None):
                export.main([f"checkpoint={name}", "format=safetensors", shared, f"hydra.run.dir={folder}/run"])
        with contextlib.redirect_stdout(None):
            export.main(
                ["checkpoint=contact_sequence", "format=pt2", f"output={folder}/x.pt2", f"hydra.run.dir={folder}/run"]
            )
        turn += 1
        finished(turn)


def _check_exported(folder: Path, least: int) -> None:
    for path in folder.glob("[!.]*.safetensors"):
        read_checkpoint(path)
    for path in folder.glob("[!.]*.pt2"):
        open_exported(path)
    assert len(list(folder.glob("[!.]*.*"))) >= (3 if least else 0)


def _annotate(folder: Path, finished: Finished) -> None:
    file = AnnotationFile(folder, CLOCK)
    labels, revision = file.read()
    count = len(labels["left"])
    while True:
        count += 1
        spans = [[0.1 * k, 0.1 * k + 0.05] for k in range(count)]
        revision = file.save({"contacts": {"left_hand": spans, "right_hand": []}}, revision)
        finished(count)


def _check_annotated(folder: Path, least: int) -> None:
    labels, _ = AnnotationFile(folder, CLOCK).read()
    assert len(labels["left"]) >= least
    for path in folder.glob("backups/*.json"):
        json.loads(path.read_text(encoding="utf-8"))


WRITERS = {
    "prepare": Writer(_prepare, _check_prepared, 2.0),
    "train": Writer(_train, _check_trained, 6.0),
    "capture": Writer(_capture, _check_captured, 4.0),
    "export": Writer(_export, _check_exported, 6.0),
    "annotate": Writer(_annotate, _check_annotated, 1.0),
}


def _child(writer: Writer, folder: Path, done) -> None:
    torch.set_num_threads(1)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere), contextlib.redirect_stdout(nowhere):
        writer.write(folder, lambda number: setattr(done, "value", max(done.value, number)))


def kill_one(writer: Writer, folder: Path, wait_s: float) -> tuple[bool, str]:
    """Start a writer, kill it, look: (whether the kill came while it wrote, what was lost or "")."""
    done = FORK.Value("q", 0)
    process = FORK.Process(target=_child, args=(writer, folder, done))
    process.start()
    deadline = time.monotonic() + START_S
    while process.is_alive() and not any(folder.rglob("*")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.join(wait_s)
    struck = process.is_alive()
    process.kill()
    process.join()
    if not struck:
        return False, f"the writer ended by itself with {process.exitcode}"
    try:
        writer.check(folder, done.value)
    except Exception:
        return True, traceback.format_exc(limit=-2)
    return True, ""


@contextlib.contextmanager
def _temporary_elsewhere() -> Iterator[Path]:
    """A folder to write in, with TMPDIR on another file system."""
    outputs = Path("outputs/benchmarks")
    outputs.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=outputs) as folder:
        before = os.environ.get("TMPDIR")
        if Path("/dev/shm").is_dir():
            os.environ["TMPDIR"] = "/dev/shm"
        try:
            yield Path(folder).resolve()
        finally:
            os.environ.pop("TMPDIR") if before is None else os.environ.update(TMPDIR=before)


def measure(kills: int = 100, writers: tuple[str, ...] = tuple(WRITERS), seed: int = 0) -> list[dict]:
    rng, figures, all_lost, all_struck = random.Random(seed), [], 0, 0
    with _temporary_elsewhere() as root:
        small_dataset(root / "data")
        for name in writers:
            lost, struck, folder = 0, 0, root / name
            folder.mkdir()
            for _ in track(range(-(-kills // len(writers))), name, transient=True):
                writer = WRITERS[name]
                hit, what = kill_one(writer, folder, rng.uniform(0.0, writer.within_s))
                struck += hit
                if what:
                    lost += 1
                    print(f"{name}: {what}", file=sys.stderr)
            figures.append(_figure(f"faults_{name}", lost, struck))
            all_lost, all_struck = all_lost + lost, all_struck + struck
    return [*figures, _figure("faults", all_lost, all_struck)]


def _figure(name: str, lost: int, struck: int) -> dict:
    return figure(name, lost, "kills", struck, lost / max(struck, 1), 0)
