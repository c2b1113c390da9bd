"""Configs: their location, their composition by Hydra, suggestions for typos, and the systems that they and checkpoints make."""

import functools
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.types import RunMode
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from wearcap.cli.sources import register
from wearcap.cli.stated import stated
from wearcap.cli.verbs import conf_dir
from wearcap.errors import WearcapError, nearest
from wearcap.files import resource
from wearcap.locks import LOCK
from wearcap.models.checkpoint import read_checkpoint
from wearcap.parallel import Parallel
from wearcap.reading import read
from wearcap.recording import RecordingStore
from wearcap.recording.store import MANIFEST, dataset_folder
from wearcap.runtime.needs import Need
from wearcap.runtime.system import CaptureInput, LearnedSystem, System, training_of


def splits_dir() -> Path:
    """The committed split lists, of the checkout or of the wheel."""
    return resource("data_prep/splits", "splits")


def compose(config_name: str, overrides: Iterable[str] = ()) -> DictConfig:
    """Compose one config of `conf/` with overrides (no sweep, no run folder).

    Raises WearcapError that names the nearest valid key or choice when an override is mistyped.
    """
    overrides = list(overrides)
    if config_name == "prepare":
        register(overrides, splits_dir())
    with explained(config_name, overrides):
        return _compose(config_name, [*map(readable, overrides)])


def with_pipeline(arguments: list[str]) -> list[str]:
    """A command's arguments with the pipeline of their checkpoints' system, unless they choose one or there is none.

    Raises WearcapError for checkpoints of several systems.
    """
    given = _given(arguments)
    if "pipeline" in given or "checkpoint" not in given or given["checkpoint"].value() is None:
        return arguments
    value = given["checkpoint"].value()
    values = value.list if isinstance(value, ChoiceSweep) else value if isinstance(value, list) else [value]
    flat = [part for each in values for part in (each if isinstance(each, list) else [each])]
    owners = {path: training_of(path)[1] for path in (str(getattr(part, "text", part)) for part in flat)}
    chosen = {path: owner.pipeline for path, owner in owners.items() if owner is not None and owner.pipeline}
    if len(set(chosen.values())) > 1:
        listed = ", ".join(f"{path} ({pipeline})" for path, pipeline in chosen.items())
        raise WearcapError(f"checkpoints of several pipelines: {listed}", expected="checkpoints of one pipeline")
    return [*(f"pipeline={pipeline}" for pipeline in sorted(set(chosen.values()))), *arguments]


def with_pipeline_of_content(arguments: list[str]) -> list[str]:
    """Arguments of a capture with the pipeline that the recording's streams suggest, where they name neither pipeline nor
    checkpoint: the first of the config's `by_content` all whose required inputs it has.

    Raises WearcapError for a recording that cannot be read, and for one that suits none of them.
    """
    given = _given(arguments)
    if (
        {"pipeline", "checkpoint", "live"} & set(given)
        or "recording" not in given
        or {"-m", "--multirun"} & set(arguments)
    ):
        return arguments
    where = str(getattr(value := given["recording"].value(), "text", value))
    if (Path(where) / MANIFEST).is_file() and len(RecordingStore.open(where).names()) != 1:
        return arguments
    how = stated({name: getattr(value := each.value(), "text", value) for name, each in given.items()})
    source, lacks = CaptureInput.in_dataset(read(where, how), dataset_folder(where)), {}
    for name in compose("capture", ["recording=none"]).by_content:
        made = instantiate(compose("capture", ["recording=none", f"pipeline={name}"]).pipeline, _convert_="all")
        needs = made.needs() if isinstance(made, System) else made.func.required
        lacks[name] = [need.what for need in needs if need.required and not _holds(need, source)]
        if not lacks[name]:
            print(f"pipeline={name}, by what the recording holds", file=sys.stderr)
            return [f"pipeline={name}", *arguments]
    listed = "; ".join(f"{name} lacks {', '.join(what)}" for name, what in lacks.items())
    raise WearcapError(f"no pipeline suits this recording: {listed}", where, fix="Give pipeline=… to insist on one.")


def _holds(need: Need, source: CaptureInput) -> bool:
    return need.has(source) and (need.stream is None or bool(getattr(source.recording, need.stream)))


def _given(arguments: list[str]) -> dict[str, Any]:
    """Overrides of a command line by their keys."""
    given: dict[str, Any] = {}
    for argument in arguments:
        with suppress(HydraException):  # its complaint comes when the config is composed
            override = OverridesParser.create().parse_override(readable(argument))
            given[override.key_or_group] = override
    return given


def readable(argument: str) -> str:
    """An override with its value quoted if Hydra cannot read it plain: a path with brackets, an address, a pattern."""
    key, equals, value = argument.partition("=")
    if not equals or argument[0] == "-" or value[:1] in tuple("[{'\""):
        return argument
    with suppress(HydraException):
        OverridesParser.create().parse_override(argument)
        return argument
    quoted = value.replace("'", "\\'")
    return f"{key}='{quoted}'"


def hydra_main(config_name: str, task: Callable[[DictConfig], Any], arguments: list[str]) -> None:
    """Run `task(config)` as a Hydra application of `conf/` (see `run_application`)."""
    run_application(config_name, hydra_application(config_name, task), arguments)


def hydra_application(config_name: str, task: Callable[[DictConfig], Any]) -> Callable[[], Any]:
    """What `@hydra.main` with `@guarded` makes of a task, with a config of `conf/`."""
    return hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(guarded(task))


def run_application(config_name: str, application: Callable[[], Any], arguments: list[str]) -> None:
    """Run what `hydra.main` made of a `guarded` task with its command line: overrides, `-m`, `--cfg job`, `--help` …

    A WearcapError of the task is raised unchanged; a config error is raised as a WearcapError.
    """
    with explained(config_name, arguments):
        # Hydra reads sys.argv, and with HYDRA_FULL_ERROR it raises errors instead of exiting.
        before, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
        sys.argv = [sys.argv[0], *map(readable, arguments)]
        os.environ["HYDRA_FULL_ERROR"] = "1"
        try:
            application()
        finally:
            sys.argv = before
            if full_error is None:
                os.environ.pop("HYDRA_FULL_ERROR", None)
            else:
                os.environ["HYDRA_FULL_ERROR"] = full_error
        if (refused := application.__wrapped__.refused) is not None:  # pyright: ignore[reportFunctionMemberAccess]
            raise refused


class guarded:
    """A task that stores its WearcapError for later, so that Hydra does not print its own message.

    It is a class because the joblib launcher has to pickle it. In a multirun the error passes through Hydra, which
    reports which of the jobs failed.
    """

    def __init__(self, task: Callable[[DictConfig], Any]):
        functools.update_wrapper(self, task)
        self.task = task
        self.refused: Exception | None = None

    def __call__(self, config: DictConfig) -> Any:
        try:
            _require_usable(config)
            return self.task(config)
        except (WearcapError, HydraException, OmegaConfBaseException) as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            self.refused = error
            _remove_unused(Path(HydraConfig.get().runtime.output_dir), config)


def _require_usable(config: DictConfig) -> None:
    """Raise WearcapError, before anything is computed, for a device that is not here and for outputs that cannot be written."""
    if config.get("device") is not None:
        try:
            torch.empty(0, device=config.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0].split(". ")[0]
            raise WearcapError(f"device={config.device} is not here ({reason})", fix="Give device=cpu.") from error
    for key in ("output", "record", "report"):
        if isinstance(path := config.get(key), str):
            require_writable(path, key)


def require_writable(path: str | Path, key: str) -> None:
    """Raise WearcapError if neither a file nor, where the path has no suffix, a folder can be written at a path."""
    path = Path(path).absolute()
    place = next(each for each in (path, *path.parents) if os.path.lexists(each))
    if place.is_file() and (place != path or not path.suffix):
        raise WearcapError(f"{key}={path}, but a file is in the way", place, fix=f"Give another {key}=….")
    if not os.access(place, os.W_OK):
        raise WearcapError(f"{key}={path} cannot be written", place, fix=f"Give another {key}=….")


def _remove_unused(run: Path, config: DictConfig) -> None:
    """Remove a refused run's folder, and those above it up to `paths.outputs`, if nothing but Hydra's own files lies in it."""
    own = [*run.glob("*.log"), run / LOCK, run / ".hydra"]
    if set(run.iterdir()) - set(own):
        return
    for path in own:
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    top = Path(OmegaConf.select(config, "paths.outputs", default=run)).absolute()
    with suppress(OSError):  # others have theirs there
        for folder in (run, *(each for each in run.parents if each.is_relative_to(top))):
            folder.rmdir()


def _compose(config_name: str, overrides: list[str]) -> DictConfig:
    around = GlobalHydra.instance().hydra  # of the command that this config is composed in, if it is one
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return hydra.compose(config_name, overrides)
    finally:
        GlobalHydra.instance().hydra = around


@contextmanager
def explained(config_name: str, arguments: list[str]) -> Iterator[None]:
    """Turn errors of composing or using a config into a WearcapError with a suggestion of what to type instead."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        ours: BaseException | None = error  # the first WearcapError along the chain of causes, if there is one
        while ours is not None and not isinstance(ours, WearcapError):
            ours = ours.__cause__
        if ours is not None:
            raise ours from error
        raise _explanation(error, config_name, arguments) from error


def _explanation(error: Exception, config_name: str, arguments: list[str]) -> WearcapError:
    """Explanation of a Hydra or OmegaConf error for the person who typed the command."""
    for place, argument in enumerate(arguments[:-1]):
        if argument in ("--config-name", "-cn"):
            config_name = arguments[place + 1]
    if isinstance(error, MissingConfigException):
        wrong = str(error.missing_cfg_file or "").removesuffix(".yaml")
        group, _, choice = wrong.rpartition("/")
        if not group:
            roots = [path.stem for path in conf_dir().glob("*.yaml")]
            return WearcapError(f"no config {choice!r}", where=conf_dir(), fix=nearest(choice, roots))
        folder = conf_dir() / group
        options = sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))
        if not options:
            return WearcapError(f"no config group {group!r}", fix=nearest(group, _groups()))
        return WearcapError(f"no choice {choice!r} in config group {group!r}", fix=nearest(choice, options))
    if isinstance(error, OverrideParseException):
        what, fix = f"cannot read the override {error.override!r}", f"({str(error).splitlines()[0]})"
        return WearcapError(what, expected="key=value", fix=fix)
    if missing := re.search(r"Missing mandatory value: (\S+)", str(error)):
        key = missing.group(1).rstrip(".")
        return WearcapError(f"{key} has no value", fix=f"Give it on the command line: {key}=…")
    key = re.search(r"(?:Could not override|Could not delete from config\.|Could not append) '([^']+)'", str(error))
    key = key or re.search(r"key '?([\w./@-]+)'? (?:is not in|not found)", str(error), re.IGNORECASE)
    if isinstance(error, InstantiationException):  # a configured object's constructor refused its values
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        place = re.search(r"full_key: (\S+)", str(error))
        built, why = place.group(1) if place else "what the config names", " ".join(str(cause).split()[:60])
        return WearcapError(f"cannot build {built}: {why}", fix="--debug shows where.")
    if key is None and not isinstance(error, ConfigCompositionException):
        what, fix = str(error).strip().splitlines()[0], "Run again with --debug for the whole story."
        return WearcapError(what, where=f"config {config_name!r}", fix=fix)
    if key is None:
        return WearcapError(" ".join(str(error).split()), where=f"config {config_name!r}")
    # What would be valid: config groups, and dotted keys of the config without the override that failed.
    wrong, valid = key.group(1).split("@")[0], set(_groups())
    rest = [a for a in arguments if "=" in a and not a.startswith("-") and wrong not in a and "," not in a]
    with suppress(HydraException, OmegaConfBaseException):
        valid |= set(_dotted(_compose(config_name, rest)))
    if wrong.startswith("presets."):
        presets = sorted({key.split(".")[1] for key in valid if key.startswith("presets.")})
        return WearcapError(f"no preset {wrong.split('.')[1]!r}", expected=f"preset={' or preset='.join(presets)}")
    return WearcapError(f"config {config_name!r} has no key {wrong!r}", fix=nearest(wrong, valid))


def _groups() -> list[str]:
    root = conf_dir()
    return sorted({path.parent.relative_to(root).as_posix() for path in root.rglob("*.yaml")} - {".", "hydra"})


def _dotted(config: Any, prefix: str = "") -> Iterator[str]:
    if not isinstance(config, DictConfig) or config._is_missing() or config._is_none():
        return
    for key in config:
        yield f"{prefix}{key}"
        if not OmegaConf.is_missing(config, key) and not OmegaConf.is_interpolation(config, key):
            value = config[key]
            if not isinstance(value, ListConfig):
                yield from _dotted(value, f"{prefix}{key}.")


def load_pipeline(
    checkpoint: str | Path | Sequence[str] | None, pipeline: Any, device: str, shared: bool = False
) -> System:
    """The system of a pipeline config; one with a network (`_partial_`) takes it from checkpoints.

    `shared`: without a checkpoint, the shared ones that the system names are used. Raises WearcapError for a system
    with a network without a checkpoint, and for a checkpoint that the system cannot use.
    """
    given = [checkpoint] if isinstance(checkpoint, str | Path) else list(checkpoint or ())
    return load_systems(given, pipeline, device, shared)[0]


def load_systems(given: Sequence[str | Path], pipeline: Any, device: str, shared: bool = False) -> list[System]:
    """The system of a pipeline config with all checkpoints, or one system for each of them; raises as `load_pipeline`."""
    kind: type[System] = get_class(pipeline["_target_"])
    if "refine" in pipeline and not issubclass(kind, LearnedSystem):
        what = f"refine=…, but {kind.__name__} is no system whose network predicts a motion"
        raise WearcapError(what, fix="Leave refine=… out, or choose another pipeline=….")
    made = instantiate(pipeline, _convert_="all")
    if isinstance(made, System):
        if given:
            what = f"a checkpoint, but {type(made).__name__} has no network"
            raise WearcapError(what, where=given[0], fix="Leave checkpoint=… out, or choose another pipeline=….")
        return [made]
    given = given or (list(kind.shared) if shared else [])
    if not given:
        fix = "Give checkpoint=…, or a pipeline without one, such as pipeline=hps."
        raise WearcapError(f"no checkpoint, but {kind.__name__} needs a trained network", fix=fix)
    together = [given] if kind.joins_checkpoints else [[checkpoint] for checkpoint in given]
    return [kind.trained(made, checkpoints, device) for checkpoints in together]


def sampling(system: System) -> System:
    """The system, with its network, that draws one of the plausible motions for each seed. Raises WearcapError where it has no
    such configuration."""
    if system.sampled is None:
        raise WearcapError(
            f"samples of {system.name}, which draws none", expected="hmd2 or echo", fix="Give samples=1."
        )
    pipeline = compose("capture", ["recording=none", f"pipeline={system.sampled}"]).pipeline
    return replace(cast(Any, system), sampling=instantiate(pipeline.sampling, _convert_="all"))


def trained_on(checkpoint: str | Path) -> tuple[list[str], str]:
    """(folders of the training data sets, folder of the validation data set) of a checkpoint.

    Raises WearcapError for a checkpoint that was shared without them.
    """
    data = read_checkpoint(checkpoint)[0].get("data", {})
    if not data.get("sources"):
        what = "this checkpoint does not name the data it was trained on"
        raise WearcapError(what, where=checkpoint, fix="Give dataset=DIR and baselines=false.")
    sources = [source["root"] for source in data["sources"].values() if source]
    validated = [source["root"] for source in (data.get("val_sources") or data["sources"]).values() if source]
    return sources, validated[0]


def parallel_of(config: DictConfig) -> Parallel:
    """How a command's recordings are spread: its `jobs` (null: one per core, on a GPU one), `backend`, `scheduler`."""
    jobs = config.jobs if config.jobs is not None else -1 if config.device == "cpu" else 1
    return Parallel(jobs, config.backend, config.scheduler, threads=None)
