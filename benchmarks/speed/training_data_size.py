"""Large data sets, generated: seconds until a training draws, memory of the host, windows per second, halves of two processes.

    python -m benchmarks.speed.training_data_size FOLDER [--hours 40] [--clip-seconds 13] [--sources datasets/cmu] [--before]

AMASS's size is 40 hours of clips of 13 s, Nymeria's `--hours 300 --clip-seconds 900`, at 30 frames a second: 0.1 GB an
hour. A set that the folder has is used again. Each figure is of a process of its own, which trains mocap_every_mlp:
`…_prepare`: seconds until the first batch where nothing is cached; `…_start`: the same at the next start; `…_memory`: MB of
its resident memory that the data takes after `seconds` of drawing; `…_windows`: windows per second of one thread. Baselines
are windows drawn one by one (`--before`; else 0). `…_halves`: share of the windows of two processes (gloo) that are those of
one process, each in one of both; its baseline is 1.
"""

import argparse
import json
import os
import socket
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from omegaconf import DictConfig

from benchmarks.rivals.single_windows.compose import data_before
from benchmarks.speed.figures import figure
from benchmarks.speed.training_paths import config_of, data_now, samples
from benchmarks.speed.training_sets import generated, sources_of, write_set

FPS = 30.0


class Start(NamedTuple):
    """A process that draws windows of a data set."""

    seconds: float
    """Until its first batch."""
    memory_mb: float
    windows_per_second: float


def measure(
    folder: str | None = None,
    hours: float = 0.5,
    clip_seconds: float = 13.0,
    sources: str | None = None,
    before: bool = True,
    seconds: float = 10.0,
) -> list[dict]:
    """Of a set in a folder (None: a temporary one), generated of `sources` (None: bodies that swing their joints)."""
    with TemporaryDirectory() as temporary:
        root = Path(folder or temporary)
        if not (root / "cmu" / "manifest.json").is_file():
            people = sources_of(Path(sources) if sources else None)
            write_set(root / "cmu", generated(people, hours, clip_seconds, FPS))
        sides = [[_alone(started, str(root), side, seconds) for _ in range(2)] for side in (False, True)[: 1 + before]]
        (first, again), (old_first, old_again) = sides[0], sides[-1] if before else (Start(0, 0, 0),) * 2
        name = f"training_data_size_{hours:g}h"
        rows = [
            ("prepare", first.seconds, "s", old_first.seconds),
            ("start", again.seconds, "s", old_again.seconds),
            ("memory", again.memory_mb, "MB", old_again.memory_mb),
            ("windows", again.windows_per_second, "windows/s", old_again.windows_per_second),
        ]
        figures = [figure(f"{name}_{part}", a, unit, b, b / a, None) for part, a, unit, b in rows]
        figures[-1]["ratio"] = again.windows_per_second / max(old_again.windows_per_second, 1e-9) if before else 0.0
        share = halves(str(root))
        return [*figures, figure(f"{name}_halves", share, "of the windows", 1.0, share, 1.0)]


def _config(folder: str) -> DictConfig:
    """A training on the set alone, at its rate."""
    given = "people@data.sources=none", "data.sources.simulated=null", "data.dataset.every=1"
    return config_of("mocap_every_mlp", Path(folder), *given)


def _alone(run: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function in a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(run, *arguments).result()


def started(folder: str, before: bool, seconds: float) -> Start:
    """Draw windows for some seconds, in batches or one by one."""
    torch.set_num_threads(1)
    config = _config(folder)
    free, begin = _resident_mb(), time.perf_counter()
    made: Any = data_before(config) if before else data_now(config)
    windows, size, count = made.dataset("train"), config.data.loading.batch_size, 0
    windows.batch(*samples(windows, size))
    first = time.perf_counter()
    while time.perf_counter() - first < seconds:
        count += 1
        windows.batch(*samples(windows, size, count))
    rate = count * size / (time.perf_counter() - first)
    return Start(first - begin, _resident_mb() - free, rate)


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def halves(folder: str, batches: int = 4) -> float:
    """Share of one process's windows that just one of two processes draws, at the same steps."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        parts = [pool.submit(half, folder, address, rank, batches) for rank in range(2)]
        both, again = (part.result() for part in parts)
    assert both == again
    whole = _alone(drawn, folder, 0, 1, batches)
    steps = ((sorted(a + b), sorted(one)) for a, b, one in zip(*both, whole))
    alike = sum(len(set(one) & set(two)) for two, one in steps if len(set(two)) == len(two))
    return alike / sum(map(len, whole))


def half(folder: str, address: str, rank: int, batches: int) -> list[list[list[str]]]:
    """What both processes draw, as each of them knows of the other."""
    dist.init_process_group("gloo", init_method=address, rank=rank, world_size=2)
    found: list[Any] = [None, None]
    dist.all_gather_object(found, drawn(folder, rank, 2, batches))
    dist.destroy_process_group()
    return found


def drawn(folder: str, rank: int, world: int, batches: int) -> list[list[str]]:
    """The windows of a process's first batches, each by what its tensors hold."""
    torch.set_num_threads(1)
    config = _config(folder)
    config.data.loading.batch_size = 32 // world
    data = data_now(config)
    data.trainer = SimpleNamespace(
        global_rank=rank, world_size=world, strategy=SimpleNamespace(root_device=torch.device("cpu"))
    )
    data.setup("fit")
    made = (batch for _, batch in zip(range(batches), data.train_dataloader()))
    return [[sha256(row.numpy().tobytes()).hexdigest() for row in batch.R_world_wrist] for batch in made]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", help="of the generated set")
    parser.add_argument("--hours", type=float, default=40.0)
    parser.add_argument("--clip-seconds", type=float, default=13.0)
    parser.add_argument("--sources", help="data set of recorded people whose motions are varied")
    parser.add_argument("--before", action="store_true", help="also measure windows drawn one by one")
    for row in measure(**vars(parser.parse_args(arguments))):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
