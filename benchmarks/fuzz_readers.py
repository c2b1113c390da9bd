"""Every reader of wearcap.io is given damaged files: it must read them or say in a WearcapError what is wrong.

    python benchmarks/fuzz_readers.py [READER ...] [--inputs 100000] [--seed 0] [--seconds S] [--jobs 2]

Prints one JSON line per reader and a total: how many inputs were read, how many refused with a WearcapError, other
exceptions by type and place, inputs that took longer than 5 seconds, that needed more than 1.5 GiB, and that ended
the process; the highest memory in use (MiB). The first input of each kind that failed is kept under
outputs/fuzz/READER/. An input is known by its seed, reader and number, whatever the number of jobs.
Leaves with 1 when anything but a result or a WearcapError came.
"""

import argparse
import contextlib
import hashlib
import json
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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import av
import torch
from fuzz_files import READERS
from fuzz_mutate import mutated
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from wearcap.errors import WearcapError

ALARM_S, DEAF_S, MEMORY_BYTES = 5.0, 30.0, 3 << 29
"""An input's time; that of one which hears no alarm; memory beyond what the imports take."""
BLOCK = 2000
_FORK = multiprocessing.get_context("fork")


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


def _place(error: Exception) -> str:
    """The last line of wearcap's that the exception passed."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/wearcap/" in frame.filename]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"


class Fuzzed:
    """The files of a reader in a folder of their own, damaged one after another."""

    def __init__(self, name: str, seed: int, folder: Path):
        self.name, self.seed, self.folder, self.reader = name, seed, folder, READERS[name]
        torch.manual_seed(0)
        self.reader.write(folder)
        self.files = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}

    def damage(self, number: int) -> Path:
        """Write input `number`; returns the file that is damaged."""
        digest = hashlib.sha256(f"{self.seed} {self.name} {number}".encode()).digest()
        random_ = random.Random(digest)
        path = random_.choice(list(self.files))
        other = random_.choice(list(self.files.values()))
        path.write_bytes(mutated(self.files[path], other, random_))
        return path

    def run(self, number: int, kept: Path | None = None, alarm_s: float = 0.0) -> str:
        """Read input `number`; a failure's files are kept in a folder below `kept`. `alarm_s`: its time, in a process that
        hears the alarm; 0: any."""
        path = self.damage(number)
        signal.setitimer(signal.ITIMER_REAL, alarm_s)
        try:
            found = outcome(self.reader.read, self.folder)
        except TooSlowError:
            found = "slow"
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        if found not in ("fine", "refused") and kept is not None:
            self.keep(found, number, kept)
        path.write_bytes(self.files[path])
        return found

    def keep(self, found: str, number: int, kept: Path) -> None:
        place = kept / self.name / "".join(c if c.isalnum() or c in ".-" else "_" for c in found)[:100]
        if not place.exists():
            shutil.copytree(self.folder, place / f"input_{number}")


def _limit_worker() -> None:
    """Memory and alarm of a worker process."""

    def ring(*_: object) -> None:
        raise TooSlowError

    signal.signal(signal.SIGALRM, ring)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY_BYTES, resource.RLIM_INFINITY))
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)  # libraries in C speak to both
    os.dup2(null, 2)


def _work(name: str, seed: int, first: int, last: int, kept: Path, place, pipe) -> None:
    """A worker process: inputs `first` to `last` of a reader; `place` holds which one is being read, and since when."""
    _limit_worker()
    shared = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=shared) as folder:
        fuzzed = Fuzzed(name, seed, Path(folder))
        counts: Counter[str] = Counter()
        for number in range(first, last):
            place[0], place[1] = number, time.monotonic()
            counts[fuzzed.run(number, kept, ALARM_S)] += 1
        pipe.send((counts, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))


def block(name: str, seed: int, first: int, last: int, kept: Path) -> tuple[Counter[str], float]:
    """Outcomes of some inputs and the peak of memory (MiB), in processes that may end or hang."""
    counts, peak, place = Counter(), 0.0, _FORK.Array("d", 2, lock=False)
    while first < last:
        place[0], place[1] = first, time.monotonic()
        receiver, sender = _FORK.Pipe(duplex=False)
        worker = _FORK.Process(target=_work, args=(name, seed, first, last, kept, place, sender), daemon=True)
        worker.start()
        sender.close()
        while not receiver.poll(0.05) and worker.is_alive() and time.monotonic() - place[1] < DEAF_S:
            pass
        with contextlib.suppress(EOFError):
            found, used = receiver.recv() if receiver.poll(0) else (None, 0.0)
            if found is not None:
                worker.join()
                return counts + found, max(peak, used)
        ended = "hangs" if worker.is_alive() else f"process ended with {worker.exitcode}"
        worker.kill()
        worker.join()
        number = int(place[0])
        with tempfile.TemporaryDirectory() as folder:
            fuzzed = Fuzzed(name, seed, Path(folder))
            fuzzed.damage(number)
            fuzzed.keep(ended, number, kept)
        again, used = block(name, seed, first, number, kept) if number > first else (Counter(), 0.0)
        counts, peak, first = counts + again + Counter({ended: 1}), max(peak, used), number + 1
    return counts, peak


def fuzz(name: str, inputs: int, seed: int, kept: Path, stop_s: float = float("inf"), jobs: int = 1, step=None) -> dict:
    """Outcomes of `inputs` damaged files, or as many as are read until the clock `stop_s`."""
    begin, counts, peak = time.monotonic(), Counter(), 0.0
    for found, used in _blocks(name, inputs, seed, kept, stop_s, jobs):
        counts, peak = counts + found, max(peak, used)
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
        "peak_mib": round(peak),
        "seconds": round(time.monotonic() - begin, 1),
    }


def _blocks(
    name: str, inputs: int, seed: int, kept: Path, stop_s: float, jobs: int
) -> Iterator[tuple[Counter[str], float]]:
    def one(first: int) -> tuple[Counter[str], float]:
        if time.monotonic() > stop_s:
            return Counter(), 0.0
        return block(name, seed, first, min(first + BLOCK, inputs), kept)

    with ThreadPoolExecutor(jobs) as threads:
        yield from threads.map(one, range(0, inputs, BLOCK))


def failed(row: dict) -> bool:
    return bool(row["slow"] or row["memory"] or row["others"])


def main(arguments: list[str] | None = None) -> int:
    """Fuzz the named readers; 1 when one of them failed."""
    words = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=words)
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(READERS)} (default: all)")
    parser.add_argument("--inputs", type=int, default=100_000, help="for each reader (default: 100000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for each reader at most")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--output", type=Path, default=Path("outputs/fuzz"), help="folder of what failed")
    options = parser.parse_args(arguments)
    if unknown := set(options.readers) - set(READERS):
        parser.error(f"no reader {', '.join(sorted(unknown))}. Expected some of {', '.join(READERS)}.")
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows, begin = [], time.monotonic()
    columns = (TextColumn("{task.description:22}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        names = options.readers or list(READERS)
        task = progress.add_task("", total=options.inputs * len(names))
        for name in names:
            progress.update(task, description=name)
            stop_s = time.monotonic() + options.seconds
            rows.append(
                fuzz(
                    name,
                    options.inputs,
                    options.seed,
                    options.output,
                    stop_s,
                    options.jobs,
                    lambda count: progress.advance(task, count),
                )
            )
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
