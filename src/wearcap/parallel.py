"""Items spread over processes by joblib: one machine or a cluster, results as they are finished, one reason per failure."""

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import joblib
from joblib.externals.loky import get_reusable_executor
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from wearcap.errors import WearcapError, require_choice
from wearcap.extras import missing
from wearcap.workers import bound_to_this_process

BACKENDS = ("loky", "threading", "dask", "ray")
MAX_REASON = 500
"""Most characters of the reported reason why an item failed."""
AT_ONCE = 64
"""Items given at once to a backend that returns results chunk by chunk."""

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Parallel:
    """How items are spread over processes. Raises WearcapError for an unknown backend, and for no jobs."""

    jobs: int = -1
    """Number of items at a time, as joblib counts (-1: one per core); with 1 they are processed in this process."""
    backend: str = "loky"
    """One of `BACKENDS`; "dask" without a `scheduler` has that many local workers."""
    scheduler: str | None = None
    """Address of a dask scheduler."""
    threads: int | None = 1
    """Threads of each local worker process; None: as many as leave no core idle."""

    def __post_init__(self):
        if self.jobs == 0:
            raise WearcapError("0 jobs", expected="a number of jobs, or -1 for one per core")
        require_choice(self.backend, BACKENDS, f"no backend {self.backend!r}")

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], root: Path, lock: int | None = None
    ) -> Generator[Result, None, None]:
        """`function` of each item, in the order in which they are finished.

        Local workers end with this process and before the `lock` is released. Raises WearcapError, naming the folder
        `root` that they write into, when one was killed, and for a backend that is not installed.
        """
        if not items:
            return
        with self._backend(lock) as as_generator:
            chunk_size = len(items) if as_generator else AT_ONCE
            results_as = "generator_unordered" if as_generator else "list"
            parallel = joblib.Parallel(n_jobs=self.jobs, batch_size=1, return_as=results_as)
            for start in range(0, len(items), chunk_size):
                try:
                    results: Any = parallel(
                        joblib.delayed(function)(item) for item in items[start : start + chunk_size]
                    )
                    yield from results
                except BrokenExecutor as error:
                    fix = "What is finished is kept: run again with fewer jobs."
                    raise WearcapError("a worker process was killed (out of memory?)", root, fix=fix) from error

    @contextmanager
    def _backend(self, lock: int | None) -> Iterator[bool]:
        """Activate joblib's backend; yields whether it can return results as they are finished."""
        try:
            if self.backend == "dask":
                from dask.distributed import Client  # type: ignore[import-not-found]

                workers = joblib.cpu_count() if self.jobs < 1 else self.jobs
                local = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
                client = Client(self.scheduler) if self.scheduler else Client(**local)
                with client, joblib.parallel_config("dask"):
                    yield True
            elif self.backend == "ray":
                from ray.util.joblib import register_ray  # type: ignore[import-not-found]

                register_ray()
                with joblib.parallel_config("ray"):
                    yield False
            elif self.backend == "loky":
                threads = self.threads or max(1, joblib.cpu_count() // joblib.effective_n_jobs(self.jobs))
                bound = bound_to_this_process(lock)
                with joblib.parallel_config("loky", inner_max_num_threads=threads, **bound):
                    try:
                        yield True
                    finally:
                        if joblib.effective_n_jobs(self.jobs) > 1:
                            get_reusable_executor(reuse=True).shutdown(kill_workers=True)
            else:
                with joblib.parallel_config(self.backend):
                    yield True
        except ModuleNotFoundError as error:
            raise missing(error.name or self.backend, f"the backend {self.backend!r}") from error


def reason_of(error: Exception) -> str:
    """One line that says why an item failed."""
    reason = str(error) if isinstance(error, WearcapError) else f"{type(error).__name__}: {error}"
    return " ".join(reason.split())[:MAX_REASON]


@contextmanager
def progress_bar(total: int, done: int = 0, transient: bool = False) -> Iterator[Callable[[], None]]:
    """Progress bar of recordings on stderr; the yielded function is called for each finished one.

    `transient`: it is shown on a terminal only, and only while it progresses.
    """
    columns = (TextColumn("recordings"), BarColumn(), MofNCompleteColumn(), TextColumn("left:"), TimeRemainingColumn())
    console = Console(stderr=True)
    hidden = transient and not console.is_terminal
    with Progress(*columns, console=console, transient=transient, disable=hidden) as bar:
        line = bar.add_task("recordings", total=total, completed=done)
        yield lambda: bar.advance(line)


def divided(items: Iterable[Item], size: int) -> list[list[Item]]:
    """Items in order, in chunks of `size`."""
    items = list(items)
    return [items[start : start + size] for start in range(0, len(items), size)]
