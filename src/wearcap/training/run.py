"""One training run: its folder, resuming, and the record of config, commit and library versions."""

import ctypes
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import lightning
import torch

from wearcap.data.datamodule import SeededWindows
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.training.checkpoint import require_resumable


@runtime_checkable
class System(Protocol):
    """A LightningModule that normalises its inputs by statistics of its training windows."""

    def set_statistics(self, dataset: Any) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...


def fit(system: System, data: SeededWindows, trainer: lightning.Trainer, resume: Path | None = None) -> None:
    """Train from scratch or resume from a checkpoint; a killed run resumes without repeating or skipping a step."""
    if resume is None:
        system.set_statistics(data.dataset("train"))
    else:
        require_resumable(resume, system.state_dict())
    trainer.fit(system, datamodule=data, ckpt_path=resume, weights_only=True)


def keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next training step instead of returning it to the system.

    On the CPU a step frees and allocates hundreds of megabytes; allocating them again costs about a fifth of its time.
    Without glibc this does nothing.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    trim_threshold, mmap_threshold = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h
    libc = ctypes.CDLL(None)
    libc.mallopt(mmap_threshold, 32 << 20)  # the most that glibc accepts
    libc.mallopt(trim_threshold, 2**31 - 1)


def resume_path(resume: str | None, own: Path, runs: Path) -> Path | None:
    """The checkpoint to resume from: none, a path, or with "auto" the `last.ckpt` of the run's own folder, else the
    newest in `runs`."""
    if resume is None:
        return None
    if resume != "auto":
        if not Path(resume).is_file():
            raise WearcapError(
                "no such checkpoint to resume from",
                where=resume,
                expected="a run's .ckpt file, or resume=auto for the newest",
            )
        return Path(resume)
    if (mine := own / "checkpoints" / "last.ckpt").is_file():
        return mine
    found = sorted(runs.glob("**/last.ckpt"), key=lambda path: path.stat().st_mtime)
    return found[-1] if found else None


def record_run(folder: Path, config_yaml: str) -> None:
    """Write the config, the git commit and the library versions into a run's folder."""
    names = ("wearcap", "torch", "lightning", "numpy", "hydra-core", "numba", "anny")
    record = {
        "commit": _git_commit(),
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, "
        + (torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"),
        "versions": {name: importlib.metadata.version(name) for name in names},
    }
    write_text(folder / "config.yaml", config_yaml)
    write_text(folder / "run.json", json.dumps(record, indent=1) + "\n")


def _git_commit() -> str:
    here = Path(__file__).parent
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        return subprocess.run(command, cwd=here, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "not a git checkout"
