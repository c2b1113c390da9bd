"""One training run: its folder, its checkpoints, resuming, and the record of config, commit and library versions."""

import ctypes
import importlib.metadata
import io
import json
import os
import platform
import subprocess
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import lightning
import torch
import yaml
from lightning.fabric.plugins.io.checkpoint_io import CheckpointIO
from lightning.pytorch import Callback
from torch import Tensor

from wearcap.boundary.opening import understood
from wearcap.boundary.own import remember_own, require_own
from wearcap.boundary.tensors import plain_tensors
from wearcap.boundary.texts import parse_json, read_yaml_object
from wearcap.data.datamodule import WindowsModule
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.models.checkpoint import Training as Taken
from wearcap.models.checkpoint import read_checkpoint, read_run_file
from wearcap.models.weights import check_weights
from wearcap.training.base import Training
from wearcap.version import __version__

FREE_TO_CHANGE = (
    *("paths.", "resume.", "init.", "test.", "logger.", "early_stop.", "callbacks.progress.", "model.compile."),
    *(
        f"trainer.{name}."
        for name in ("accelerator", "default_root_dir", "enable_model_summary", "enable_progress_bar")
    ),
    *(f"trainer.{name}." for name in ("log_every_n_steps", "max_epochs", "max_steps", "max_time")),
)
"""Parts of a config that may change when a run goes on: its length, its record, its machine."""
TRAINING_STATE = ("state_dict", "optimizer_states", "lr_schedulers", "loops", "epoch", "global_step")
"""Entries of a checkpoint that resuming a training requires."""


class RunRecord(Callback):
    """Adds the composed config, the version and what the training has taken so far to every checkpoint, and config and
    number of trained parameters to every logger.

    The config's entry "training" holds the number of trained "parameters" and of "steps", the "frames" of all windows
    drawn (samples, where they have no time axis), the "seconds" of training without its validations, the "core_seconds"
    of the process meanwhile, and the "machine". A resumed run, and one from the weights of another (but for "steps"), adds
    to what that checkpoint records.
    """

    def __init__(self, config: dict[str, Any]):
        self.config = config
        self.stepped = False
        """Whether a step has been made."""
        self._taken = {"frames": 0, "seconds": 0.0, "core_seconds": 0.0}
        self._clocks = _clocks()

    def setup(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        if stage == "fit":
            for logger in trainer.loggers:
                logger.log_hyperparams(self.config | {"parameters": trained_parameters(pl_module)})

    def add_to(self, before: Mapping[str, Any]) -> None:
        """Count on from what an earlier training has taken, by its checkpoint's config."""
        taken = before.get("training") or {}
        self._taken = {name: taken.get(name, value) for name, value in self._taken.items()}

    def on_train_start(self, trainer, pl_module) -> None:
        self._clocks = _clocks()

    def on_validation_start(self, trainer, pl_module) -> None:
        for name, start, end in zip(("seconds", "core_seconds"), self._clocks, _clocks()):
            self._taken[name] += end - start

    def on_validation_end(self, trainer, pl_module) -> None:
        self._clocks = _clocks()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx: int) -> None:
        self.stepped = True
        frames = len(batch[0]) * getattr(trainer.datamodule.train, "window", 1)  # pyright: ignore[reportAttributeAccessIssue]
        self._taken["frames"] += frames * trainer.world_size

    def on_save_checkpoint(self, trainer, pl_module, checkpoint: dict[str, Any]) -> None:
        training = {
            "parameters": trained_parameters(pl_module),
            "steps": trainer.global_step,
            **self._taken,
            "machine": machine(),
        }
        config = json.dumps(self.config | {"training": training})
        checkpoint["wearcap"] = {"version": __version__, "config": config}


def trained_parameters(module: torch.nn.Module) -> int:
    """Number of a module's trained parameters."""
    return sum(each.numel() for each in module.parameters() if each.requires_grad)


class RunCheckpointIO(CheckpointIO):
    """Writes checkpoints atomically (synced beside the target, then renamed): a killed run leaves the old or new file.

    Lightning's own writer copies over the old file when the folder of temporary files is on another file system.
    """

    def __init__(self, folder: str | Path):
        """`folder`: of the run; checkpoints elsewhere, which a file to resume from may name, are never removed."""
        self.folder = Path(folder).resolve()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint. Raises WearcapError when the disk is full or the folder cannot be written."""
        content = io.BytesIO()  # PyTorch's own writing to a file does not report why it failed
        torch.save(checkpoint, content)
        with atomic_path(path) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint onto the CPU. Raises WearcapError as `read_run_file` does."""
        return read_run_file(path)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a checkpoint of this run."""
        path = Path(path).resolve()
        if self.folder in path.parents and path.suffix == ".ckpt":
            path.unlink(missing_ok=True)


def fit(
    system: Training,
    data: WindowsModule,
    trainer: lightning.Trainer,
    resume: Path | None = None,
    init: str | Path | None = None,
) -> None:
    """Train from scratch, from the weights and statistics of the checkpoint `init`, or resume from a checkpoint.

    A killed run resumes without repeating or skipping a step.
    """
    record = next((each for each in trainer.callbacks if isinstance(each, RunRecord)), None)  # pyright: ignore[reportAttributeAccessIssue]
    if resume is not None:
        before = require_resumable(resume, system.state_dict())
    elif init is not None:
        before = start_from(init, system)
    else:
        before = {}
        system.set_statistics(data.dataset("train"))
    if record is not None:
        record.add_to(before)
    try:
        trainer.fit(system, datamodule=data, ckpt_path=resume, weights_only=True)
    except Exception as error:  # Lightning and the optimisers raise anything for states that are not theirs
        if resume is None or record is None or record.stepped or isinstance(error, WearcapError):
            raise
        what = f"a training cannot go on from it ({type(error).__name__}: {' '.join(str(error).split())[:160]})"
        raise WearcapError(what, resume, "a run's .ckpt file, as `wearcap train` writes it") from error


class _Resumed(TypedDict):
    training: NotRequired[Taken | None]


def require_resumable(path: str | Path, own: Mapping[str, Tensor]) -> _Resumed:
    """What a training run's checkpoint has taken. Raises WearcapError unless it is one, whose weights fit a model's own.

    Nothing else of its config is read: the command line defines the training.
    """
    saved = read_run_file(path)
    missing = [key for key in TRAINING_STATE if key not in saved]
    if missing:
        what = f"a checkpoint without {missing[0]}"
        raise WearcapError(what, where=path, expected="a run's .ckpt file, as `wearcap train` writes it")
    check_weights(own, plain_tensors(saved["state_dict"], path), "this model", path)
    about = saved.get("wearcap")
    text = about.get("config") if isinstance(about, dict) else None
    return parse_json(text if isinstance(text, str) else "{}", path, "config", schema=_Resumed)


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


def affordable_precision(precision: str, accelerator: str) -> str:
    """`trainer.precision` as it is asked for, but float32 in place of bfloat16 on a CPU that has no instructions for bfloat16.

    PyTorch then computes it in software, and a training step takes tens of times as long.
    """
    on_cpu = accelerator == "cpu" or (accelerator == "auto" and not torch.accelerator.is_available())
    if not (precision.startswith("bf16") and on_cpu) or computes_bfloat16():
        return precision
    return "32-true"


def require_accelerator(accelerator: str) -> None:
    """Raise WearcapError for `trainer.accelerator` gpu or cuda where there is no GPU."""
    if accelerator in ("gpu", "cuda") and not torch.accelerator.is_available():
        what, fix = f"trainer.accelerator={accelerator}, but there is no GPU here", "Give trainer=default."
        raise WearcapError(what, fix=fix)


def computes_bfloat16() -> bool:
    """Whether this machine's CPU has instructions for bfloat16."""
    if platform.machine() in ("x86_64", "AMD64"):
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.ops.mkldnn._is_mkldnn_bf16_supported()


def resume_path(resume: str | None, run: Path, config_yaml: str) -> Path | None:
    """The checkpoint to resume from: none, a path, or ("auto") the `last.ckpt` of the run's own folder if it has one.

    Raises WearcapError for a missing file, and for "auto" in the folder of a run with another config.
    """
    if resume is None:
        return None
    if resume != "auto":
        if not os.path.isfile(resume):
            expected = "a run's .ckpt file, or resume=auto for this run's own"
            raise WearcapError("no such checkpoint to resume from", where=resume[:200], expected=expected)
        require_own(resume)
        return Path(resume)
    last = last_checkpoint(run)
    if not last.is_file():
        return None
    if not (run / "config.yaml").is_file():
        raise WearcapError("no config.yaml of the run to go on with", run, fix=f"Give resume={last}.")
    if different := differing_keys(read_yaml_object(run / "config.yaml"), config_yaml):
        raise _another_config(run, different)
    return last


def last_checkpoint(run: Path) -> Path:
    """The newest checkpoint of a run's folder."""
    return run / "checkpoints" / "last.ckpt"


def run_to_continue(runs: Path, config_yaml: str) -> Path | None:
    """The newest run in a folder that was trained with a config, its seed included; None if no run has its seed.

    A run whose config cannot be read is passed over, with a warning. Raises WearcapError, with the differing keys, when
    the runs of that seed have other configs.
    """
    seed, refused = yaml.safe_load(config_yaml)["seed"], None
    found = [path.parents[1] for path in runs.glob("**/last.ckpt") if (path.parents[1] / "config.yaml").is_file()]
    for run in sorted(found, key=lambda run: last_checkpoint(run).stat().st_mtime, reverse=True):
        try:
            recorded = read_yaml_object(run / "config.yaml")
            if recorded.get("seed") != seed:
                continue
            different = differing_keys(recorded, config_yaml)
        except WearcapError as error:
            warnings.warn(f"a run that cannot be gone on with: {error}", stacklevel=2)
            continue
        if not different:
            return run
        refused = refused or _another_config(run, different)
    if refused is not None:
        raise refused
    return None


def differing_keys(before: dict[str, Any], now: str) -> list[str]:
    """Keys, with both values, in which a run's config and one of now (YAML) would train differently; `FREE_TO_CHANGE` does
    not count. Raises WearcapError for a config that is none of a run."""
    with understood("no config of a training run", "config.yaml", "one that `wearcap train` wrote"):
        values = [dict(_leaves(config, str(config["paths"]["run"]))) for config in (before, yaml.safe_load(now))]
    keys = [key for key in {**values[0], **values[1]} if not f"{key}.".startswith(FREE_TO_CHANGE)]
    none = "nothing"
    pairs = [(key, values[0].get(key, none), values[1].get(key, none)) for key in keys]
    return [f"{key} ({old}, now {new})" for key, old, new in pairs if old != new]


def _leaves(config: Any, run: str, key: str = "") -> Iterator[tuple[str, Any]]:
    """Values of a config by dotted key; a path within the run's folder is given relative to it."""
    if isinstance(config, dict) and config:
        for name, value in config.items():
            yield from _leaves(value, run, f"{key}.{name}" if key else str(name))
    elif isinstance(config, str) and config.startswith(run):
        yield key, f"RUN{config.removeprefix(run)}"
    else:
        yield key, config


def _another_config(run: Path, different: list[str]) -> WearcapError:
    shown = ", ".join(different[:8]) + (f" and {len(different) - 8} more" if len(different) > 8 else "")
    fix = (
        f"Give resume={last_checkpoint(run)} to go on with these settings, another name=…, or leave resume=auto out to "
        "train anew."
    )
    return WearcapError(f"this run was trained with another config: {shown}", run, "the same config and seed", fix)


def start_from(checkpoint: str | Path, system: Training) -> dict[str, Any]:
    """Give a system the weights and statistics of a checkpoint, whose config is returned; its optimiser starts anew.

    Raises WearcapError that names the tensors that are missing, unexpected or of another size.
    """
    own, (config, state) = system.state_dict(), read_checkpoint(checkpoint)
    sizes = {
        f"{name} ({list(state[name].shape)}, here {list(value.shape)})": None
        for name, value in own.items()
        if name in state and state[name].shape != value.shape
    }
    missing, unexpected = (dict.fromkeys(sorted(set(a) - set(b))) for a, b in ((own, state), (state, own)))
    wrong = {"missing": missing, "unexpected": unexpected, "of another size": sizes}
    if any(wrong.values()):
        parts = [
            f"{len(names)} {kind}: {', '.join(list(names)[:6])}{' …' if len(names) > 6 else ''}"
            for kind, names in wrong.items()
            if names
        ]
        fix = "Give init=… a checkpoint of the same experiment, or the settings that it was trained with."
        raise WearcapError(f"its weights are not this model's; {'; '.join(parts)}", checkpoint, fix=fix)
    system.load_state_dict(state)
    return config


def _clocks() -> tuple[float, float]:
    """Seconds of a clock on the wall, and of this process on all cores."""
    return time.perf_counter(), time.process_time()


def machine() -> str:
    """The machine that trains: its processor or GPU, and its threads."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    return f"{platform.machine()}, {torch.get_num_threads()} threads, {device}"


def record_run(folder: Path, config_yaml: str) -> None:
    """Write the config, the git commit and the library versions into a run's folder."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        here = Path(__file__).parent
        commit = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "not a git checkout"
    names = ("torch", "lightning", "numpy", "hydra-core", "numba")
    record = {
        "commit": commit,
        "python": platform.python_version(),
        "machine": machine(),
        "versions": {"wearcap": __version__} | {name: importlib.metadata.version(name) for name in names},
    }
    remember_own(folder)
    write_text(folder / "config.yaml", config_yaml)
    write_text(folder / "run.json", json.dumps(record, indent=1) + "\n")
