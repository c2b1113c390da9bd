"""Every reader of files and messages is given damaged ones: it must read them or say in a WearcapError what is wrong.

    python tests/fuzz_readers.py [READER ...] [--inputs 100000] [--seed 0] [--seconds S] [--jobs 2]

Prints one JSON line per reader and a total: how many inputs were read, how many refused with a WearcapError, other
exceptions by type and place, inputs that took longer than 5 seconds of the processor, that took more memory than 10
times the files' size and 100 MiB (on Linux) or than 1.5 GiB, and that ended the process; the most memory that one input
took (MiB). The first input of each kind that failed is kept under outputs/fuzz/READER/. An input is known by its seed,
reader and number, whatever the number of jobs.
Leaves with 1 when anything but a result or a WearcapError came.
"""

import argparse
import contextlib
import hashlib
import json
import math
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import av
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import valid_files
import valid_own_files
from fuzz_mutate import mutated
from wearcap.errors import WearcapError

READERS = valid_files.READERS | valid_own_files.OWN
ALARM_S, DEAF_S, MEMORY_BYTES = 5.0, 30.0, 3 << 29
"""An input's time; that of one which hears no alarm; memory beyond what the imports take."""
FREE_BYTES, TIMES_FILES = 100 << 20, 10
"""Memory that an input may take: so much, and so many times the size of the files."""
BLOCK = 2000
"""Inputs that a worker process reads."""
_PEAK, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
_FORK = multiprocessing.get_context("fork")
SHARED = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Where the files are: in memory, where there is such a folder."""


class TooSlowError(BaseException):
    """The alarm: no reader may catch it."""


def outcome(read, folder: Path) -> str:
    """What became of an input: "fine", "refused", "memory", "slow", or the exception's type and place."""
    try:
        read(folder)
        return "fine"
    except TooSlowError:
        return "slow"
    except WearcapError as error:
        # FFmpeg calls it lack of memory when a header asks for more than it ever reserves.
        lacking = any(
            isinstance(cause, MemoryError) and not isinstance(cause, av.FFmpegError) for cause in _causes(error)
        )
        return "memory" if lacking else "refused"
    except MemoryError:
        return "memory"
    except Exception as error:
        return f"{type(error).__name__} at {_place(error)}"


def _causes(error: BaseException) -> list[BaseException]:
    """An error and what led to it; errors that are each other's causes are listed once."""
    causes: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and not any(cause is seen for seen in causes):
        causes.append(cause)
        cause = cause.__cause__ or cause.__context__
    return causes


def _memory(line: str) -> int:
    """Bytes that a line of the process's status tells: VmRSS now, VmHWM at most; 0 elsewhere than on Linux."""
    if not _STATUS.exists():
        return 0
    return next(int(row.split()[1]) << 10 for row in _STATUS.read_text().splitlines() if row.startswith(line))


def _place(error: Exception) -> str:
    """The last line of wearcap's that the exception passed."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/wearcap/" in frame.filename]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"


class Fuzzed:
    """The files of a reader in a folder of their own, damaged one after another."""

    def __init__(self, name: str, seed: int, folder: Path, files: dict[str, bytes]):
        """`files`: the valid ones, by their paths in the folder."""
        self.name, self.seed, self.folder, self.reader = name, seed, folder, READERS[name]
        self.files, self.peak = files, 0

    def reset(self, *names: str) -> None:
        """Make files of the folder the valid ones; without names all."""
        for name in names or self.files:
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(self.files[name])

    def damage(self, number: int) -> tuple[str, int]:
        """Write input `number`; returns the file that is damaged, and the size of all."""
        random_ = random.Random(hashlib.sha256(f"{self.seed} {self.name} {number}".encode()).digest())
        name, other = random_.choice(list(self.files)), random_.choice(list(self.files))
        content = mutated(self.files[name], self.files[other], random_)
        (self.folder / name).write_bytes(content)
        return name, len(content) + sum(map(len, self.files.values())) - len(self.files[name])

    def run(self, number: int, kept: Path) -> str:
        """Read input `number`, in a process that hears the alarm; a failure's files are kept in a folder below `kept`."""
        name, size = self.damage(number)
        before = self._begin()
        try:
            signal.setitimer(signal.ITIMER_PROF, ALARM_S)
            try:
                found = outcome(self.reader.read, self.folder)
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
        except TooSlowError:
            found = "slow"
        taken = _memory("VmHWM") - before
        self.peak = max(self.peak, taken)
        if found in ("fine", "refused") and taken > FREE_BYTES + TIMES_FILES * size:
            found = "memory"
        if found not in ("fine", "refused"):
            self.keep(found, number, kept)
        self.reset(name)
        return found

    @staticmethod
    def _begin() -> int:
        """Memory in use (bytes), from which on the peak is measured."""
        if _PEAK.exists():
            _PEAK.write_text("5")
        return _memory("VmRSS")

    def keep(self, found: str, number: int, kept: Path) -> None:
        place = kept / self.name / "".join(c if c.isalnum() or c in ".-" else "_" for c in found)[:100]
        if not place.exists():
            shutil.copytree(self.folder, place / f"input_{number}")


def _limit_worker() -> None:
    """Memory and alarm of a worker process."""

    def ring(*_: object) -> None:
        raise TooSlowError

    signal.signal(signal.SIGPROF, ring)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY_BYTES, resource.RLIM_INFINITY))
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)  # libraries in C speak to both
    os.dup2(null, 2)


def _write(name: str, folder: Path) -> None:
    """A process that writes a reader's valid files: what writes them may draw numbers and redirect streams."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    READERS[name].write(folder)


def _contents(folder: Path) -> dict[str, bytes]:
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def _work(name: str, seed: int, first: int, last: int, files: dict, kept: Path, place, pipe) -> None:
    """A worker process: inputs `first` to `last` of a reader; `place` holds which one is being read, and since when."""
    _limit_worker()
    with tempfile.TemporaryDirectory(dir=SHARED) as folder:
        fuzzed = Fuzzed(name, seed, Path(folder), files)
        fuzzed.reset()
        counts: Counter[str] = Counter()
        # What is imported and remembered is no input's.
        if (valid := outcome(fuzzed.reader.read, fuzzed.folder)) != "fine":
            counts[f"valid files: {valid}"] += 1
        for number in range(first, last):
            place[0], place[1] = number, time.monotonic()
            counts[fuzzed.run(number, kept)] += 1
        pipe.send((counts, fuzzed.peak))


def block(name: str, seed: int, first: int, last: int, files: dict, kept: Path) -> tuple[Counter[str], int]:
    """Outcomes of some inputs and the most memory of one (bytes), in processes that may end or hang."""
    counts, peak, place = Counter(), 0, _FORK.Array("d", 2, lock=False)
    while first < last:
        place[0], place[1] = first, time.monotonic()
        receiver, sender = _FORK.Pipe(duplex=False)
        worker = _FORK.Process(target=_work, args=(name, seed, first, last, files, kept, place, sender), daemon=True)
        worker.start()
        sender.close()
        while not receiver.poll(0.05) and worker.is_alive() and time.monotonic() - place[1] < DEAF_S:
            pass
        with contextlib.suppress(EOFError):
            found, used = receiver.recv() if receiver.poll(0) else (None, 0)
            if found is not None:
                worker.join()
                return counts + found, max(peak, used)
        worker.join(1)  # the pipe closes a moment before the process ends
        ended = "hangs" if worker.is_alive() else f"process ended with {worker.exitcode}"
        worker.kill()
        worker.join()
        number = int(place[0])
        with tempfile.TemporaryDirectory(dir=SHARED) as folder:
            fuzzed = Fuzzed(name, seed, Path(folder), files)
            fuzzed.reset()
            fuzzed.damage(number)
            fuzzed.keep(ended, number, kept)
        again, used = block(name, seed, first, number, files, kept) if number > first else (Counter(), 0)
        counts, peak, first = counts + again + Counter({ended: 1}), max(peak, used), number + 1
    return counts, peak


def fuzz(name: str, inputs: int, seed: int, kept: Path, seconds: float = math.inf, step=None) -> dict:
    """Outcomes of `inputs` damaged files, or of as many as are read in some seconds."""
    begin, counts, peak, first = time.monotonic(), Counter(), 0, 0
    with tempfile.TemporaryDirectory(dir=SHARED) as folder:
        writer = _FORK.Process(target=_write, args=(name, Path(folder)))
        writer.start()
        writer.join()
        files = _contents(Path(folder))
    while first < inputs and time.monotonic() < begin + seconds:
        found, used = block(name, seed, first, min(first + BLOCK, inputs), files, kept)
        counts, peak, first = counts + found, max(peak, used), first + BLOCK
        if step is not None:
            step(found.total())
    others = {key: n for key, n in sorted(counts.items()) if key not in ("fine", "refused", "slow", "memory")}
    return {
        "reader": name,
        "inputs": counts.total(),
        "fine": counts["fine"],
        "refused": counts["refused"],
        "slow": counts["slow"],
        "memory": counts["memory"],
        "others": others,
        "peak_mib": round(peak / (1 << 20)),
        "seconds": round(time.monotonic() - begin, 1),
    }


def failed(row: dict) -> bool:
    return bool(row["slow"] or row["memory"] or row["others"])


def main(arguments: list[str] | None = None) -> int:
    """Fuzz the named readers; 1 when one of them failed."""
    words = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=words)
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(READERS)} (default: all)")
    parser.add_argument("--inputs", type=int, default=100_000, help="for each reader (default: 100000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=math.inf, help="for each reader at most")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--output", type=Path, default=Path("outputs/fuzz"), help="folder of what failed")
    options = parser.parse_args(arguments)
    if unknown := set(options.readers) - set(READERS):
        parser.error(f"no reader {', '.join(sorted(unknown))}. Expected some of {', '.join(READERS)}.")
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows, begin = [], time.monotonic()
    columns = (TextColumn("readers"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=Console(stderr=True), transient=True) as progress,
        ThreadPoolExecutor(options.jobs) as threads,
    ):
        names = options.readers or list(READERS)
        task = progress.add_task("", total=options.inputs * len(names))

        def one(name: str) -> dict:
            step = lambda count: progress.advance(task, count)  # noqa: E731
            return fuzz(name, options.inputs, options.seed, options.output, options.seconds, step)

        for row in as_completed([threads.submit(one, name) for name in names]):
            rows.append(row.result())
            print(json.dumps(rows[-1]), flush=True)
    sums = {key: sum(row[key] for row in rows) for key in ("inputs", "fine", "refused", "slow", "memory")}
    others = sum((Counter(row["others"]) for row in rows), Counter())
    print(
        json.dumps(
            {"reader": "total", "readers": len(rows)}
            | sums
            | {
                "others": dict(others),
                "peak_mib": max(row["peak_mib"] for row in rows),
                "seconds": round(time.monotonic() - begin, 1),
            }
        )
    )
    return int(any(map(failed, rows)))


if __name__ == "__main__":
    sys.exit(main())
