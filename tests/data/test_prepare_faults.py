"""The preparation engine under faults: killed at any moment, started twice, its workers left alone."""

import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import prepare_tasks
import pytest
from prepare_tasks import tasks

from data_prep.shared import engine
from data_prep.shared.engine import prepare
from wearcap import locks
from wearcap.errors import WearcapError
from wearcap.files import sha256_of, write_text
from wearcap.locks import LOCK
from wearcap.parallel import Parallel
from wearcap.recording import RecordingStore

posix = pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="/proc tells who lives")

UNBOUND_WORKER = """
import sys, time
from joblib.externals.loky import get_reusable_executor
from wearcap.locks import folder_lock
from wearcap.workers import _Inherited

def nothing(lock):
    pass

def work():
    import os, time
    print(os.getpid(), flush=True)
    time.sleep(60)

with folder_lock(sys.argv[1], "prepare") as lock:
    get_reusable_executor(1, initializer=nothing, initargs=(_Inherited(lock),)).submit(work).result()
"""


def digests(root: Path) -> dict[str, str]:
    return {path.relative_to(root).as_posix(): sha256_of(path) for path in root.rglob("*") if path.is_file()}


def made(root: Path) -> list[Path]:
    return list(root.glob("recordings/[!.]*"))


def wait_until(condition, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come about in time"
        time.sleep(0.002)


def descendants(pid: int) -> list[int]:
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        parents[int(stat.parent.name)] = int(fields[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


def lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@contextmanager
def preparing(root: Path, count: int, seconds: float, jobs: int, backend: str = "loky"):
    """A run in a process of its own, killed at the end with all that it started."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(Path(__file__).parent)])}
    command = [sys.executable, prepare_tasks.__file__, root, count, seconds, jobs, backend]
    process = subprocess.Popen([str(word) for word in command], env=environment)
    children = []
    try:
        wait_until(lambda: len(made(root)) >= 2 or process.poll() is not None)
        children += descendants(process.pid)
        yield process, children
    finally:
        process.kill()
        process.wait()
        for child in filter(lives, children):
            os.kill(child, signal.SIGKILL)


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """Twelve recordings made one after another, without a fault."""
    root = tmp_path_factory.mktemp("alone")
    prepare(tasks(12), root, jobs=1)
    return root


@linux
@pytest.mark.slow
@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_workers_end_with_a_killed_run_and_the_next_one_has_the_folder_alone(alone, tmp_path, backend):
    if backend == "dask":
        pytest.importorskip("distributed")
    with preparing(tmp_path, 12, 0.5, 2, backend) as (process, children):
        assert len(children) >= 2
        process.kill()
        process.wait()
        wait_until(lambda: not any(map(lives, children)), 2.0)
        left = digests(tmp_path)
        time.sleep(1.0)
        assert digests(tmp_path) == left, "nobody writes on"
        assert len(made(tmp_path)) < 12
    prepare(tasks(12), tmp_path, jobs=1)
    assert digests(tmp_path) == digests(alone)


STUCK = """
import sys
from prepare_tasks import tasks
from data_prep.shared import engine
from data_prep.shared.engine import prepare
prepare(tasks(2, r00="stuck", r01="stuck"), sys.argv[1], jobs=2)
"""


@linux
def test_workers_end_within_native_code(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(Path(__file__).parent)])}
    command = [sys.executable, "-c", STUCK, tmp_path]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    children = []
    assert process.stdout is not None
    try:
        assert [process.stdout.readline() for _ in range(2)] == ["stuck\n"] * 2
        children += descendants(process.pid)
        process.kill()
        process.wait()
        wait_until(lambda: not any(map(lives, children)), 2.0)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        for child in filter(lives, children):
            os.kill(child, signal.SIGKILL)


@linux
@pytest.mark.filterwarnings("ignore:.*have been cancelled")
def test_an_interrupted_run_ends_its_workers_before_it_gives_the_folder_up(tmp_path, monkeypatch):
    before, after = set(descendants(os.getpid())), []

    @contextmanager
    def noted(*arguments):
        with locks.folder_lock(*arguments) as lock:
            try:
                yield lock
            finally:
                after.extend(Path(f"/proc/{pid}/cmdline") for pid in descendants(os.getpid()) if pid not in before)
                after[:] = [path for path in after if path.exists() and "popen_loky" in path.read_text()]

    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(engine, "folder_lock", noted)
    monkeypatch.setattr(engine, "progress_bar", lambda *arguments: nullcontext(interrupt))
    with pytest.raises(KeyboardInterrupt):
        prepare(tasks(6, 0.2), tmp_path, jobs=2)
    assert not after


def test_nothing_to_do_starts_no_workers(tmp_path, monkeypatch):
    prepare(tasks(2), tmp_path, jobs=1)
    monkeypatch.setattr(Parallel, "_backend", None)
    assert prepare(tasks(2), tmp_path, jobs=2, backend="dask").current == ["r00", "r01"]


@posix
def test_a_second_run_into_the_folder_is_refused_and_harms_nothing(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "LOCK_PATIENCE_S", 0.1)
    with preparing(tmp_path, 12, 0.2, 1) as (process, _):
        with pytest.raises(WearcapError, match=rf"another run writes here \(process {process.pid} on "):
            prepare(tasks(12), tmp_path, jobs=1)
        assert all(wrong is None for _, wrong in RecordingStore.open(tmp_path).verify()), "readers go on"
        assert process.wait(60) == 0
    assert digests(tmp_path) == digests(alone)


@posix
def test_a_folder_in_which_orphans_write_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "ORPHANS_PATIENCE_S", 0.1)
    process = subprocess.Popen([sys.executable, "-c", UNBOUND_WORKER, tmp_path], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        orphan = int(process.stdout.readline())
    process.kill()
    process.wait()
    try:
        with pytest.raises(WearcapError, match=rf"workers of a run that has ended .+process {process.pid} on"):
            prepare(tasks(1), tmp_path, jobs=1)
    finally:
        os.kill(orphan, signal.SIGKILL)
    monkeypatch.setattr(locks, "ORPHANS_PATIENCE_S", 20.0)
    prepare(tasks(1), tmp_path, jobs=1)
    assert LOCK not in digests(tmp_path)


def holds(process, root: Path) -> bool:
    """Whether a process has taken the folder, or has ended."""
    lock = root / LOCK
    return not process.is_alive() or (lock.exists() and f'"pid": {process.pid},' in lock.read_text())


@posix
def test_kills_at_random_moments_leave_the_same_bytes(alone, tmp_path, monkeypatch):
    """Each run is started as soon as the one before it was killed; every eighth is left to come to its end.

    `benchmarks/faults/faults.py` kills hundreds.
    """
    moments, kills = random.Random(0), 0
    context = multiprocessing.get_context("forkserver")  # what it has imported, a run need not import again
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*sys.path, str(Path(__file__).parent)]))
    context.set_forkserver_preload([prepare_tasks.__name__])
    for number in range(16):
        root = tmp_path / str(number // 8)
        process = context.Process(target=prepare_tasks.run, args=(str(root), 12, 0.05))
        process.start()
        if number % 8 < 7:
            wait_until(partial(holds, process, root))
            process.join(moments.uniform(0, 0.1))
            process.kill()
        process.join()
        kills += process.exitcode == -signal.SIGKILL
        if number % 8 == 7:
            assert process.exitcode == 0
            assert digests(root) == digests(alone)
    assert kills >= 2, "the first one of each folder had all its work before it"


@linux
@pytest.mark.slow
def test_kills_of_a_run_with_workers_leave_the_same_bytes(alone, tmp_path):
    moments = random.Random(1)
    for _ in range(3):
        with preparing(tmp_path, 12, 0.3, 2) as (process, _):
            time.sleep(moments.uniform(0, 0.5))
            process.kill()
        if moments.random() < 0.5:
            shutil.rmtree(tmp_path / "recordings")  # so that every run has work to be killed in
    prepare(tasks(12), tmp_path, jobs=2)
    assert digests(tmp_path) == digests(alone)


def test_what_a_killed_run_left_anywhere_in_the_data_set_is_removed(alone, tmp_path):
    for folder in ("", "recordings", "scenes/room", "cache/places-0"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / ".room.tmp-0123abcd.ply").write_bytes(b"half")
    write_text(tmp_path / LOCK, '{"pid": 1}')
    prepare(tasks(12), tmp_path, jobs=1)
    assert digests(tmp_path) == digests(alone)
